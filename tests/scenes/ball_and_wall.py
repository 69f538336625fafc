"""A clip of a textured ball that moves in front of a wall, and the loop that fits it."""

import dataclasses

import numpy as np

from morgs_mi import rasterize
from morgs_mi.core.color_space import SH_C0
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.stream_loop import StreamLoop
from tests.quick import NO_DENSITY, quick
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.gaussians import isotropic

SHIFT = np.array([0.06, 0.02, 0.0])  # about 3 px a frame
QUICK = quick(  # from all points, as the images were made of them
    MotionConfig(key_views=2),
    num_gaussians=600,
    first_frame_steps=150,
    dropout=0.0,
    confidence_steps=20,
    epochs=4,
    density=NO_DENSITY,
)
SHORT = dataclasses.replace(QUICK, fit=dataclasses.replace(QUICK.fit, first_frame_steps=20))


def scene(frame):
    """A textured ball that moves by SHIFT in front of a static textured wall; and the mask of the
    moving Gaussians.

    The wall is thick: its Gaussians lie in the same order in every view.
    """
    rng = np.random.default_rng(0)
    wall = rng.uniform((-2.4, -2.0, 0.6), (2.4, 2.0, 2.0), (500, 3))
    direction = rng.normal(size=(120, 3))
    ball = (
        0.5 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        + (-0.2, 0, -0.4)
        + frame * SHIFT
    )
    moves = np.r_[np.zeros(len(wall), bool), np.ones(len(ball), bool)]
    sh = rng.uniform(-1.6, 1.6, (len(moves), 1, 3))
    return isotropic(np.concatenate([wall, ball]), np.where(moves, 0.09, 0.16), 0.95, sh), moves


def cameras():
    return look_at_cameras([*QUAD, (0, 0, -3.5)], 50, 96, 72, [f"cam{i:02d}" for i in range(5)])


def shown(gaussians, camera):
    """Return the image of Gaussians, clipped."""
    return np.clip(np.asarray(rasterize(gaussians, camera, ("color",)).color), 0, 1)


def recorded():
    """Return the images of five views in four frames; the last view is held out."""
    return [
        [np.uint8(shown(scene(t)[0], camera) * 255 + 0.5) for camera in cameras()] for t in range(4)
    ]


def points_and_colors():
    points = scene(0)[0].numpy()
    return points["means"], np.clip(points["sh_coeffs"][:, 0] * SH_C0 + 0.5, 0, 1)


def new_loop(config=QUICK):
    return StreamLoop(cameras()[:4], *points_and_colors(), config)


def run(clip, config=QUICK, frames=3):
    loop = new_loop(config)
    packets, reports = zip(*(loop.push(images[:4]) for images in clip[:frames]), strict=True)
    return loop, packets, reports


def with_fit(config=QUICK, **changes):
    """Return a configuration with changed fields of its fit."""
    return dataclasses.replace(config, fit=dataclasses.replace(config.fit, **changes))

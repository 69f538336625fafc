"""Recordings that are hard to reconstruct: noise for hundreds of frames, exposures that differ by
1000, too few cameras, and nothing to see.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi import Camera, rasterize
from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.stream_loop import StreamLoop
from tests.quick import NO_DENSITY, quick
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.gaussians import isotropic

CONFIG = quick(
    MotionConfig(key_views=1),
    num_gaussians=200,
    first_frame_steps=100,
    dropout=0.0,
    density=NO_DENSITY,
)
RIG = tuple(look_at_cameras(QUAD, 50, 48, 36))
Images = Sequence[np.ndarray]


@dataclass(frozen=True)
class HardFit:
    """A recording, and the number of frames that the report fits.

    Attributes:
        name: of the recording.
        cameras: the rig.
        recorded: function from the true images [H, W, 3] in [0, 1] to those of frame t.
        num_frames: of the recording.
        psnr: which the first and the last frame exceed in the first view, dB.
        textured: whether the scene has a texture.
    """

    name: str
    cameras: tuple[Camera, ...]
    recorded: Callable[[Images, int], Images]
    num_frames: int = 4
    psnr: float = 20.0
    textured: bool = True


def scene(textured):
    """Return a dense ball of small Gaussians of random colours, or of one grey."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = 1.4 * direction * np.cbrt(rng.uniform(size=(200, 1)))
    colors = rng.uniform(-1.4, 1.4, (200, 1, 3)) if textured else np.zeros((200, 1, 3))
    return isotropic(means, 0.25, 0.9, colors)


def eight_bits(images, noise=0.0, frame=0):
    rng = np.random.default_rng(frame)
    noisy = (image + noise * rng.normal(size=image.shape) for image in images)
    return [np.uint8(np.clip(image, 0, 1) * 255 + 0.5) for image in noisy]


def bracketed(images, frame):
    """Return 8-bit images whose exposures span a factor of 1000."""
    factors = np.geomspace(1000**-0.5, 1000**0.5, len(images))
    lights = (decode_light(image) * f for image, f in zip(images, factors, strict=True))
    return eight_bits([encode_light(light) for light in lights])


HARD_FITS = [
    HardFit("still, noise of 0.03", RIG, lambda images, t: eight_bits(images, 0.03, t), 300),
    HardFit("exposures 1:1000", RIG, bracketed, psnr=10.0),
    HardFit("one camera", RIG[:1], lambda images, t: eight_bits(images)),
    HardFit(
        "two equal cameras",
        (RIG[0], replace(RIG[0], name="again")),
        lambda images, t: eight_bits(images),
    ),
    HardFit("no texture", RIG, lambda images, t: eight_bits(images), textured=False),
    HardFit("black", RIG, lambda images, t: [np.zeros((36, 48, 3), np.uint8) for _ in images]),
]


def fitted(fit, num_frames=None):
    """Yield the PSNR of the first view against the truth, the raw attributes and the status of each
    frame.
    """
    truth = scene(fit.textured)
    images = [
        np.clip(np.asarray(rasterize(truth, camera, ("color",)).color), 0, 1)
        for camera in fit.cameras
    ]
    if fit.name == "black":
        images = [0 * image for image in images]
    raw = truth.numpy()
    loop = StreamLoop(fit.cameras, raw["means"], np.full((200, 3), 0.5), CONFIG)
    for frame in range(num_frames or fit.num_frames):
        _, report = loop.push(fit.recorded(images, frame))
        color = np.asarray(rasterize(loop.gaussians, fit.cameras[0], ("color",)).color)
        quality = psnr(np.clip(color, 0, 1), images[0])
        yield quality, loop.gaussians.numpy(), report.status

"""A clip of `filmed` as long videos, and its calibration."""

from functools import cache
from unittest.mock import Mock

import numpy as np

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.io.video_writer import write_video
from morgs_mi.platform.png import png_bytes
from tests.quick import quick
from tests.scenes import filmed, textured

FPS = 20.0
REPEATS = 60  # of the clip in a video, which then lasts longer than a fit of a few frames
NAMES = tuple(camera.name for camera in filmed.rig())
# Enough for a rough image, and slower than the clip.
CONFIG = quick(num_gaussians=1500, first_frame_steps=150, epochs=2)


@cache
def clips():
    """Return the clip of each camera: 16 frames that swing to and fro and can be repeated."""
    forth = filmed.film(9)
    return [[*clip, *clip[-2:0:-1]] for clip in forth]


def write_calibration(path):
    """Write the calibration of the cameras with a photo of each, and points on the planes."""
    rng = np.random.default_rng(0)
    points, colors = textured.points(rng, 1500)
    write_colmap(path / "sparse" / "0", filmed.rig(), points, colors)
    for name, clip in zip(NAMES, clips(), strict=True):
        (path / f"{name}.png").write_bytes(png_bytes(clip[0]))
    return path


def write_videos(folder):
    """Write the clip of each camera, many times in succession, as a video; return their paths."""
    paths = [folder / f"{name}.mkv" for name in NAMES]
    for path, clip in zip(paths, clips(), strict=True):
        write_video(path, REPEATS * clip, FPS)
    return paths


def connection(*images, opens=True):
    """Return what OpenCV opens: a camera or an address that delivers some images."""
    reads = [(True, image) for image in images] + [(False, None)] * 99
    return Mock(**{"isOpened.return_value": opens, "read.side_effect": reads})

"""A capture of moving noise from three cameras, for tests of the command line, and what can be
wrong with its clips.
"""

import numpy as np

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.io.video_writer import write_video
from tests.scenes.cameras import look_at_cameras

WIDTH = 48
HEIGHT = 32
FRAMES = 3
NAMES = ("cam0", "cam1", "cam2")


def rig():
    return look_at_cameras([(x, 0, -3) for x in (-0.4, 0, 0.4)], 60, WIDTH, HEIGHT)


def clip(count=FRAMES):
    return [
        np.roll(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8), t, 1)
        for t in range(count)
    ]


def write_capture(path):
    """Write the clips as .mkv, which stays readable up to where it is cut off."""
    points = np.random.default_rng(1).uniform(-1, 1, (150, 3))
    write_colmap(path / "sparse" / "0", rig(), points, np.abs(points))
    for name in NAMES:
        write_video(path / f"{name}.mkv", clip(), 25)
    return path


def truncate_clip(path):
    """Cut cam1 off after its first frame."""
    data = (path / "cam1.mkv").read_bytes()
    (path / "cam1.mkv").write_bytes(data[: len(data) * 2 // 3])

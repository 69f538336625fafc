"""A recording of three tiny views, and a process that fits it until it is killed.

`python -m tests.scenes.recording OUT` prints "ready" when it begins; with a further number it kills
itself within the write that brings the bytes written to that many.
"""

import os
import signal
import sys
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame, RecordedView
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.codec import container
from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.core.view import Views
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.playback.visualise import write_png
from morgs_mi.runs.fit_capture import stream_capture
from tests.quick import quick
from tests.scenes.cameras import look_at_cameras

FRAMES = 6
# As little as a fit can do with all that it does: births, deaths, masks, keyframes, offsets.
CONFIG = quick(
    MotionConfig(key_views=1, mask_interval=2),
    codec=CodecConfig(keyframe_interval=2),
    epochs=2,
    density=DensityConfig(rounds=2, births=0.05, max_gaussians=84, min_error=0),
)


class Recording(Capture):
    """A bright square that moves over a dull wall."""

    def partial_frames(self, start=0, stop=None):
        rng = np.random.default_rng(0)
        walls = [
            np.repeat(np.repeat(rng.integers(90, 110, (6, 8, 3), np.uint8), 4, 0), 4, 1)
            for _ in self.cameras
        ]
        for t in range(start, self.num_frames if stop is None else stop):
            images = np.stack(walls)
            images[:, 8:16, 2 * t % 24 : 2 * t % 24 + 8] = (255, 200, 40)
            yield PartialFrame(t, self.views.at(images))

    def metadata(self):
        return {"layout": "noise"}


def recording(**changes):
    """Return the recording, with some fields replaced."""
    rng = np.random.default_rng(1)
    views = look_at_cameras([(x, 0, -3) for x in (-1, 0, 1)], 60, 32, 24)
    fields = {
        "path": Path("noise"),
        "views": Views(RecordedView(view, reader=None, times=None) for view in views),
        "num_frames": FRAMES,
        "fps": 25.0,
        "points": rng.uniform(-1, 1, (150, 3)).astype(np.float32),
        "point_colors": rng.uniform(0, 1, (150, 3)).astype(np.float32),
        "truth": None,
    }
    return Recording(**(fields | changes))


def write_recording(path, num_frames=FRAMES):
    """Write the recording as a capture of PNG files, which other processes can open."""
    scene = recording(num_frames=num_frames)
    write_colmap(path / "sparse" / "0", scene.cameras, scene.points, scene.point_colors)
    for frame in scene.partial_frames():
        for name, image in zip(scene.names, frame.images, strict=True):
            write_png(path / name / f"{frame.index:04d}.png", image)
    return path


class Dying:
    """A file that kills its process after `left` more bytes."""

    def __init__(self, file, left):
        self.file = file
        self.left = left

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        done = self.file.write(data[: self.left])
        self.left -= done
        if not self.left:
            os.kill(os.getpid(), signal.SIGKILL)
        return done


if __name__ == "__main__":
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    if len(sys.argv) > 2:
        container.open = lambda *args, **more: Dying(open(*args, **more), int(sys.argv[2]))  # noqa: SIM115
    print("ready", flush=True)
    stream_capture(recording(), sys.argv[1], CONFIG, resume=True)

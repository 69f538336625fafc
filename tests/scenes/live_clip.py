"""A clip of `filmed` that is played in a loop at its own speed: into a folder, or as a video
through a pipe.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from itertools import count
from pathlib import Path
from threading import Event, Thread

import numpy as np

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.core.png import png_bytes
from morgs_mi.io.video_writer import write_video
from tests.quick import quick
from tests.scenes import filmed, textured

FPS = 20.0
NAMES = tuple(camera.name for camera in filmed.rig())
# Enough for a rough image, and slower than the clip.
CONFIG = quick(num_gaussians=1500, first_frame_steps=150, epochs=2)


@cache
def clips() -> list[list[np.ndarray]]:
    """Return the clip of each camera: 16 frames that swing to and fro and can be repeated."""
    forth = filmed.film(frames=9)
    return [[image for image in (*clip, *clip[-2:0:-1]) if image is not None] for clip in forth]


def write_calibration(path: Path) -> Path:
    """Write the calibration of the cameras with a photo of each, and points on the planes."""
    rng = np.random.default_rng(0)
    points, colors = textured.points(rng, 1500)
    write_colmap(path / "sparse" / "0", filmed.rig(), points, colors)
    for name, clip in zip(NAMES, clips(), strict=True):
        (path / f"{name}.png").write_bytes(png_bytes(clip[0]))
    return path


@contextmanager
def in_background(work) -> Iterator[None]:
    """Run `work(stopped)` in a thread until the body ends."""
    stopped = Event()
    thread = Thread(target=work, args=(stopped,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join(timeout=10)


def filling(folder: Path):
    """Return work that writes the clip into a folder again and again, in real time."""

    def fill(stopped: Event) -> None:
        start = time.monotonic()
        for t in count():
            for name, clip in zip(NAMES, clips(), strict=True):
                file = folder / name / f"{t:04d}.png"
                file.parent.mkdir(parents=True, exist_ok=True)
                data = png_bytes(clip[t % len(clip)])
                # In two parts, as a program that is slow to write it.
                with file.open("wb") as opened:
                    opened.write(data[:5000])
                    opened.flush()
                    time.sleep(0.001)
                    opened.write(data[5000:])
            if stopped.wait(max(0.0, start + (t + 1) / FPS - time.monotonic())):
                return

    return fill


def piping(pipe: Path, data: bytes, seconds: float):
    """Return work that writes the bytes of a video into a pipe at the speed at which it was
    recorded.
    """

    def write(stopped: Event) -> None:
        start = time.monotonic()
        parts = max(100, int(15 * seconds))
        with suppress(BrokenPipeError), pipe.open("wb", buffering=0) as opened:
            for k in range(parts):
                opened.write(data[len(data) * k // parts : len(data) * (k + 1) // parts])
                if stopped.wait(max(0.0, start + seconds * (k + 1) / parts - time.monotonic())):
                    return

    return write


def write_loop(path: Path, clip: Sequence[np.ndarray], repeats: int) -> bytes:
    """Return a video that repeats a clip."""
    write_video(path, [image for _ in range(repeats) for image in clip], FPS, "mp4v")
    return path.read_bytes()

"""Measure memory and time of reading a long capture of many cameras.

    python -m benchmarks.speed.capture_memory --json out.json

One noisy clip is written once and copied for every camera. Its frames are read as by a fit; memory is the process's
resident set, MiB, after every tenth frame. It may grow by the few frames of the read-ahead, but not with the length of
the clip.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.layouts.poses_bounds import write_poses_bounds
from morgs_mi.core.camera import Camera
from morgs_mi.io.video_writer import write_video


@dataclass(frozen=True)
class Options(Output):
    """Measure the memory of reading a capture."""

    cameras: int = 20
    """Number of cameras."""
    frames: int = 300
    """Number of frames per camera."""
    width: int = 1352
    """Width of the clips, px."""
    height: int = 1014
    """Height of the clips, px."""
    downscale: float = 2
    """Factor by which the frames are averaged down."""


def resident() -> float:
    """Return this process's resident set, MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * 4096 / 2**20


def clip(options: Options) -> Iterator[np.ndarray]:
    """Yield smooth, drifting images with noise."""
    rng, (y, x) = np.random.default_rng(0), np.mgrid[: options.height, : options.width].astype(np.float32)
    noise = rng.normal(0, 4, (8, options.height, options.width, 3)).astype(np.float32)
    for t in range(options.frames):
        wave = 128 + 90 * np.sin((x + 3 * t) / 60)[..., None] * np.cos(y / 45)[..., None]
        yield np.clip(wave + noise[t % 8], 0, 255).astype(np.uint8)


def write_capture(folder: Path, options: Options) -> Path:
    """Write the clips and the poses of cameras in a row."""
    names = [f"cam{i:02d}" for i in range(options.cameras)]
    size = options.width, options.height
    views = [Camera.look_at((0.1 * i, 0, -3), (0, 0, 0), (0, -1, 0), 60, *size, n) for i, n in enumerate(names)]
    write_video(folder / f"{names[0]}.mp4", clip(options), 30, "mp4v")
    for name in names[1:]:
        shutil.copyfile(folder / f"{names[0]}.mp4", folder / f"{name}.mp4")
    write_poses_bounds(folder / "poses_bounds.npy", views, np.ones((len(names), 2)))
    return folder


def measure(options: Options) -> dict[str, Any]:
    """Return the figures of one capture."""
    with tempfile.TemporaryDirectory() as folder:
        capture = load_capture(write_capture(Path(folder), options), options.downscale)
        before, rows, start = resident(), [], time.perf_counter()
        every = max(1, options.frames // 30)
        for frame in islice(capture.frames(), 0, None, every):
            rows.append({"frame": frame.index, "resident_mib": resident()})
        seconds = time.perf_counter() - start
    steady = [row["resident_mib"] for row in rows[len(rows) // 10 :]]
    one = sum(camera.width * camera.height * 3 for camera in capture.cameras) / 2**20
    return {
        "before_mib": before,
        "settled_mib": steady[0],
        "largest_mib": max(steady),
        "growth_mib": steady[-1] - steady[0],
        "frame_mib": one,
        "seconds_per_frame": seconds / options.frames,
        "rows": rows,
    }


def main() -> None:
    """Run the command line."""
    mi.set_variant("llvm_ad_rgb")
    options = tyro.cli(Options)
    settings = {name: value for name, value in asdict(options).items() if name != "json"}
    options.write({"settings": settings, **measure(options)}, unprinted=["rows"])


if __name__ == "__main__":
    main()

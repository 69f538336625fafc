"""Time the commands for files of Gaussians: opening, images, and the web page.

    python -m benchmarks.speed.splat_files --json out.json

A ball of Gaussians with SH of degree 3, as a PLY file, and the images of its first default camera.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from benchmarks.workloads import ball
from morgs_mi import open_stream, render_stream
from morgs_mi.io.ply import write_ply
from morgs_mi.playback.export.web import write_web_page

# Numbers of Gaussians.
SIZES = (100_000, 300_000, 1_000_000)
# Number of runs; the shortest time is reported, because others may use the machine.
_REPEATS = 5


@dataclass(frozen=True)
class Options(Output):
    """Time the commands for files of Gaussians."""


def seconds(work: Callable[[], Any], repeats: int = 1) -> float:
    """Return the shortest time of `work`."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return round(min(times), 3)


def measure(count: int, width: int = 1280) -> dict[str, Any]:
    """Return the figures of one size."""
    # Sizes that fill the ball alike, as a fit with more Gaussians does.
    gaussians, _ = ball(0, count, 64, 64, 0.4 * count ** (-1 / 3), sh_degree=3)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        write_ply(path, gaussians)
        stream = open_stream(path)
        camera = stream.cameras[0].with_width(width)

        def image() -> np.ndarray:
            return next(render_stream(stream, camera, ("color",)))[1]["color"]

        return {
            "gaussians": count,
            "width": camera.width,
            "height": camera.height,
            "file_megabytes": round(1e-6 * path.stat().st_size, 1),
            "open_seconds": seconds(lambda: open_stream(path), _REPEATS),
            "first_image_seconds": seconds(image),
            "image_seconds": seconds(image, _REPEATS),
            "page_seconds": seconds(lambda: write_web_page(stream, path.with_suffix(".html"))),
            "page_megabytes": round(1e-6 * path.with_suffix(".html").stat().st_size, 1),
        }


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    mi.set_variant("llvm_ad_rgb")
    options.write({"rows": [measure(count) for count in SIZES], "seed": 0})


if __name__ == "__main__":
    main()

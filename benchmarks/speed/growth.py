"""Time a later frame, and measure the memory, over pixels, Gaussians, views and active Gaussians.

    python -m benchmarks.speed.growth --fit out/basketball --json out.json

The scene is `small` of `frame_speed`, with one of its sizes changed at a time; each fit has a
process of its own, so that its memory counts alone. Times are medians of two frames after one of
warm-up, at two epochs. The frames of `--fit`, a finished fit, show how both grow over the frames.
`python -m benchmarks.pages` draws the figure.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.frame_speed import SIZES, Scene, Size, default_config, loop_of
from benchmarks.speed.output import Output
from morgs_mi.platform.bounded import read_json

BASE = SIZES["small"]
AXES: dict[str, list[Size]] = {
    "pixels": [replace(BASE, width=w, height=3 * w // 4) for w in (320, 640, 1280, 1920)],
    "Gaussians": [replace(BASE, gaussians=n) for n in (12_500, 50_000, 200_000, 800_000)],
    "views": [replace(BASE, views=n) for n in (6, 12, 24, 48)],
    "active Gaussians": [replace(BASE, movers=n) for n in (1, 3, 9, 20)],
}
"""Sizes along each axis."""
_FRAMES = 3


@dataclass(frozen=True)
class Options(Output):
    """Input and output."""

    fit: Path | None = None
    """Folder of a fit whose seconds and memory over the frames are reported; none: left out."""


def measure(size: Size) -> dict[str, float]:
    """Return the seconds of a later frame, the resident bytes after it, and the size on every
    axis.
    """
    mi.set_variant("llvm_ad_rgb")
    scene = Scene(size, 0)
    recorded = scene.recorded(_FRAMES + 1, 0)
    loop = loop_of(scene, default_config(size, 2), recorded[0])
    reports = [loop.push(images[1:])[1] for images in recorded[1:]][1:]
    return {
        "pixels": size.width * size.height,
        "Gaussians": size.gaussians,
        "views": size.views,
        "active Gaussians": median(r.active["gaussians"] for r in reports) * size.gaussians,
        "seconds": median(r.seconds for r in reports),
        "resident": reports[-1].memory["resident"],
    }


def slope(x: list[float], y: list[float]) -> float:
    """Return the exponent p of y ~ x^p by least squares of the logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def main(options: Options) -> None:
    """Run the benchmark."""
    result: dict[str, Any] = {"axes": {}}
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        for axis, sizes in AXES.items():
            points = []
            for point in pool.map(measure, sizes):
                print(axis, f"{point[axis]:.4g}", f"{point['seconds']:.2f} s", flush=True)
                points.append({name: float(f"{value:.4g}") for name, value in point.items()})
            x = [point[axis] for point in points]
            slopes = {
                name: float(f"{slope(x, [point[name] for point in points]):.2f}")
                for name in ("seconds", "resident")
            }
            result["axes"][axis] = {"points": points, "slopes": slopes}
    if options.fit is not None:
        frames = read_json(options.fit / "report.json")["frames"][1:]
        result["frames"] = [
            {
                "seconds": float(f"{frame['seconds']:.4g}"),
                "resident": float(f"{frame['memory']['resident']:.4g}"),
            }
            for frame in frames
        ]
    options.write(result, unprinted=("axes", "frames"))


if __name__ == "__main__":
    main(tyro.cli(Options))

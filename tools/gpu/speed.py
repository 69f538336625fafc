"""Milliseconds of a forward pass and of a whole optimisation step, over sizes.

    python tools/gpu/speed.py VARIANT OUT.json

The times are medians, synchronised, with warm kernels.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi import Camera, Gaussians, rasterize

SIZES = (
    (20_000, 512, 384),
    (100_000, 1352, 1014),
    (200_000, 1352, 1014),
    (1_000_000, 1920, 1080),
)


def milliseconds(call: Callable[[], None]) -> float:
    """Return the median of 15 calls after three that warm up, ms."""
    times = []
    for _ in range(18):
        start = time.perf_counter()
        call()
        dr.sync_thread()
        times.append(1e3 * (time.perf_counter() - start))
    return round(median(times[3:]), 3)


def measured(count: int, width: int, height: int) -> dict[str, float]:
    """Return the times of a random scene."""
    rng = np.random.default_rng(0)
    gaussians = Gaussians.from_activated(
        means=rng.uniform(-1, 1, (count, 3)),
        scales=np.full((count, 3), 0.3 * count ** (-1 / 3)),
        quats=rng.normal(size=(count, 4)),
        opacities=rng.uniform(0.2, 0.9, count),
        sh_coeffs=0.3 * rng.normal(size=(count, 4, 3)),
    )
    camera = Camera.look_at((0, -3.5, 0.5), (0, 0, 0), (0, 0, 1), 45, width, height)
    attributes = list(gaussians.items().values())

    def forward() -> None:
        dr.eval(rasterize(gaussians, camera).color)

    def step() -> None:
        dr.enable_grad(*attributes)
        difference = rasterize(gaussians, camera).color - 0.5
        dr.backward(dr.mean(dr.abs(difference), axis=None))
        dr.eval([dr.grad(attribute) for attribute in attributes])

    sizes = {"gaussians": count, "width": width, "height": height}
    return sizes | {"forward_ms": milliseconds(forward), "step_ms": milliseconds(step)}


def main(variant: str, out: str) -> None:
    """Write the times of all sizes."""
    mi.set_variant(variant)
    rows = [measured(*size) for size in SIZES]
    Path(out).write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print(*rows, sep="\n")


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Time the parts of a step of the renderer.

    python -m benchmarks.speed.step_parts --workloads W1.npz W2b.npz --json out.json

A part is left out, or replaced by something that costs next to nothing, and the step is timed in a
process of its own: the difference is the part's time. Results are then wrong, so pixels would stop
elsewhere; therefore no list ends early (`stop_transmittance` = 0).

- *exponentials*: alpha by one multiplication, with errors of up to 6 %.
- *sums*: gradients of a Gaussian overwrite each other instead of being added.
- *loads*: all entries of a list read the same Gaussian.
- *adjoint*: the image alone, with its projection and lists.
- *blending*: projection and lists alone.
- *all blocks*: a step on one block of the image, which leaves tracing, launches, and the projection
  of all Gaussians with its adjoint.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks import workloads
from benchmarks.speed.output import Output
from benchmarks.speed.render_speed import timed
from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.render import loops
from morgs_mi.render.active_view import ActiveView, ViewGroup
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region

_ROUNDS = 8
PARTS = ("exponentials", "sums", "loads", "adjoint", "blending", "all blocks")


@dataclass(frozen=True, kw_only=True)
class Options(Output):
    """Workloads and output."""

    workloads: tuple[Path, ...]
    """Workload files, .npz."""


def _rough_exp2(exponent: Any) -> Any:
    """Return 2^p by one multiplication: its bits are nearly linear in p (Schraudolph 1999)."""
    return dr.reinterpret_array(mi.Float, mi.Int32(dr.fma(exponent, 2.0**23, 126.94 * 2.0**23)))


def without(part: str) -> ExitStack:
    """Return the context without a part of the loops."""
    patches = ExitStack()
    if part == "exponentials":
        patches.enter_context(patch.object(loops, "exp2", _rough_exp2))
    if part == "sums":
        overwrite = lambda op, sums, packet, place, mode: dr.scatter(sums, packet, place)  # noqa: E731
        patches.enter_context(patch.object(dr, "scatter_reduce", overwrite))
    if part == "loads":
        fetch = loops.fetch_record
        same = lambda records, order, size: fetch(records, order & mi.UInt32(7), size)  # noqa: E731
        patches.enter_context(patch.object(loops, "fetch_record", same))
    return patches


def work(gaussians: Gaussians, camera: Camera, part: str) -> Callable[[], Any]:
    """Return a step without a part; "": a whole one."""
    render = RenderConfig(stop_transmittance=0.0)
    attributes = list(gaussians.items().values())
    if part == "blending":
        group = ViewGroup([ActiveView(camera, render)])
        return lambda: vars(group.draw(gaussians))
    if part == "adjoint":
        return lambda: rasterize(gaussians, camera, ("color",), config=render).color
    mask = np.ones((camera.height, camera.width), bool)
    if part == "all blocks":
        mask[:] = False
        mask[camera.height // 2, camera.width // 2] = True
    region = Region.of(mask, render) if part == "all blocks" else None
    image = np.broadcast_to(np.array(workloads.TARGET, np.float32), (*mask.shape, 3)).copy()
    target = mi.TensorXf(image if region is None else region.crop(image))
    view = ActiveView(camera, render, region)
    dr.enable_grad(attributes)

    def step() -> Any:
        color = render_view(gaussians, view).color
        dr.backward(dr.sum(dr.abs(color - target), axis=None) / image.size)
        grads = [dr.grad(value) for value in attributes]
        dr.eval(grads)
        dr.clear_grad(attributes)
        return grads

    return step


def measure(workload: Path, part: str) -> float:
    """Return the median time in ms of a step without a part."""
    mi.set_variant("llvm_ad_rgb")
    gaussians, camera = workloads.load(workload)
    with without(part):
        return timed(work(gaussians, camera, part))


def main(options: Options) -> None:
    """Run the benchmark."""
    result: dict[str, Any] = {}
    for workload in options.workloads:
        with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
            rounds = [[*pool.map(partial(measure, workload), ("", *PARTS))] for _ in range(_ROUNDS)]
        step, *others = np.min(rounds, axis=0)  # what else runs only adds
        shares = {part: round(1 - ms / step, 2) for part, ms in zip(PARTS, others, strict=True)}
        result[workload.stem] = {"step_ms": round(step, 2), "shares": shares}
    options.write(result)


if __name__ == "__main__":
    main(tyro.cli(Options))

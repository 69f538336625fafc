"""Time the renderer: one optimisation step on a workload, compared with baselines.

    python -m benchmarks.speed.render_speed --workload W1.npz --json out.json [--yardstick BIN]
    [--baselines]

The whole step is: projection, lists, forward, L1 loss against a constant, adjoint, the projection's
adjoint, and the gradients of all attributes in memory. All programs run in turn: background load
affects them equally, so compare ratios.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks import workloads
from benchmarks.speed.output import Output
from morgs_mi import Camera, Gaussians, RenderConfig, ellipsoids
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region

# Timed repetitions per round; medians are reported.
_REPEATS = 9
# Rounds, in each of which the renderer, the yardstick and the baselines run in turn.
_ROUNDS = 3


@dataclass(frozen=True, kw_only=True)
class Options(Output):
    """Workload, programs and output."""

    workload: Path
    """Workload file, .npz."""
    yardstick: Path | None = None
    """Program to compare with on the same workload."""
    baselines: bool = False
    """Whether to also time volprim_rf_basic, which is slow for more than 20,000 Gaussians."""


def timed(work: Callable[[], Any], patience: float = float("inf")) -> float:
    """Return the median time of `work` in ms, synchronised, after two runs of warm-up.

    After `patience` seconds, one warm-up and one timed run suffice.
    """
    times: list[float] = []
    while len(times) < _REPEATS + 2 and (len(times) < 2 or sum(times) < 1e3 * patience):
        dr.sync_thread()
        start = time.perf_counter()
        dr.eval(work())
        dr.sync_thread()
        times.append(1e3 * (time.perf_counter() - start))
    return median(times[2:] or times[1:])


def stages(gaussians: Gaussians, camera: Camera) -> dict[str, Callable[[], Any]]:
    """Return the timed stages by name: the whole step, and the step on a tenth of the tiles, drawn
    at random.
    """
    size = camera.height, camera.width
    target = np.broadcast_to(np.array(workloads.TARGET, np.float32), (*size, 3)).copy()
    attributes = list(gaussians.items().values())
    dr.enable_grad(attributes)

    def step(reference: Any, region: Region | None = None) -> Any:
        color = render_view(gaussians, ActiveView(camera, region=region)).color
        dr.backward(dr.sum(dr.abs(color - reference), axis=None) / target.size)
        grads = [dr.grad(value) for value in attributes]
        dr.eval(grads)
        dr.clear_grad(attributes)
        return grads

    tiles = np.random.default_rng(1).uniform(size=(-(-camera.height // 32), -(-camera.width // 32)))
    mask = np.kron(tiles <= np.quantile(tiles, 0.1), np.ones((32, 32), bool))
    region = Region.of(mask[: camera.height, : camera.width], RenderConfig())
    full = mi.TensorXf(target)
    tenth = mi.TensorXf(region.crop(target))
    return {"step": lambda: step(full), "tenth_step": lambda: step(tenth, region)}


def volprim_step(gaussians: Gaussians, camera: Camera) -> Callable[[], Any]:
    """Return a step of Mitsuba's `volprim_rf_basic` on the same Gaussians, one sample per pixel."""
    integrator = {"type": "volprim_rf_basic", "srgb_primitives": False}
    shapes = {"gaussians": ellipsoids(gaussians), "sensor": camera.sensor()}
    scene: Any = mi.load_dict({"type": "scene", "integrator": integrator, **shapes})
    params = mi.traverse(scene)
    names = [f"gaussians.{name}" for name in ("data", "opacities", "sh_coeffs")]
    dr.enable_grad([params[name] for name in names])
    params.update()

    def step() -> Any:
        image = mi.render(scene, params, spp=1)[..., :3]
        dr.backward(dr.mean(dr.abs(image - 0.5), axis=None))
        grads = [dr.grad(params[name]) for name in names]
        dr.eval(grads)
        for name in names:
            dr.clear_grad(params[name])
        return grads

    return step


def yardstick_step(program: Path, gaussians: Gaussians, camera: Camera) -> float:
    """Return the median time in ms of the whole step of an external program, which prints it for
    `BIN FILE.bin REPETITIONS THREADS`.
    """
    with tempfile.TemporaryDirectory() as folder:
        workload = Path(folder) / "workload.bin"
        workloads.write_bin(gaussians, camera, workload)
        command = [program.resolve(), workload, str(_REPEATS), str(dr.thread_count())]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    match = re.search(r"fwd\+bwd ms: median ([\d.]+)", output)
    if not match:
        raise SystemExit(f"{program}: expected a line 'fwd+bwd ms: median ...', got {output!r}")
    return float(match[1])


def figures(gaussians: Gaussians, camera: Camera, options: Options) -> dict[str, Any]:
    """Return medians over the rounds, and their ratios."""
    works = stages(gaussians, camera)
    volprim = volprim_step(gaussians, camera) if options.baselines else None
    rounds: list[dict[str, float]] = []
    for _ in range(_ROUNDS):
        row = {name: timed(work) for name, work in works.items()}
        if options.yardstick:
            row["yardstick_step"] = yardstick_step(options.yardstick, gaussians, camera)
        if volprim:
            # It takes a hundred times longer; one run is precise enough.
            row["volprim_step"] = timed(volprim, patience=0.5)
        rounds.append(row)
    result: dict[str, Any] = {
        f"{key}_ms": round(median(r[key] for r in rounds), 3) for key in rounds[0]
    }
    if options.yardstick:
        ratios = [r["step"] / r["yardstick_step"] for r in rounds]
        result["ratio_to_yardstick"] = round(median(ratios), 3)
    result["tenth_share"] = round(median(r["tenth_step"] / r["step"] for r in rounds), 3)
    return result


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant("llvm_ad_rgb")
    gaussians, camera = workloads.load(options.workload)
    workload = {
        "workload": options.workload.name,
        "gaussians": len(gaussians),
        "size": [camera.width, camera.height],
    }
    options.write(figures(gaussians, camera, options) | workload)


if __name__ == "__main__":
    main(tyro.cli(Options))

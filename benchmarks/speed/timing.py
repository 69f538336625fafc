"""Timing of one workload, and of other programs on it."""

from __future__ import annotations

import re
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.workloads import TARGET, write_bin
from morgs_mi import Camera, Gaussians, RenderConfig, ellipsoids, rasterize
from morgs_mi.render.region import Region


def timed(work: Callable[[], Any], repeats: int, patience: float = float("inf")) -> float:
    """Return the median time of `work` in ms, synchronised, after two runs of warm-up.

    After `patience` seconds, one warm-up and one timed run suffice.
    """
    times: list[float] = []
    while len(times) < repeats + 2 and (len(times) < 2 or sum(times) < 1e3 * patience):
        dr.sync_thread()
        start = time.perf_counter()
        result = work()
        dr.eval(result)
        dr.sync_thread()
        times.append(1e3 * (time.perf_counter() - start))
    return median(times[2:] or times[1:])


def stages(gaussians: Gaussians, camera: Camera) -> dict[str, Callable[[], Any]]:
    """Return the timed stages by name: the whole step, and the step on a tenth of the tiles, drawn
    at random.
    """
    target = np.broadcast_to(np.array(TARGET, np.float32), (camera.height, camera.width, 3)).copy()
    attributes = list(gaussians.items().values())
    full = mi.TensorXf(target)
    dr.enable_grad(attributes)

    def step(region: Region | None = None, reference: Any = full) -> Any:
        color = rasterize(gaussians, camera, ("color",), region=region).color
        dr.backward(dr.sum(dr.abs(color - reference), axis=None) / target.size)
        grads = [dr.grad(value) for value in attributes]
        dr.eval(grads)
        dr.clear_grad(attributes)
        return grads

    tiles = np.random.default_rng(1).uniform(size=(-(-camera.height // 32), -(-camera.width // 32)))
    mask = np.kron(tiles <= np.quantile(tiles, 0.1), np.ones((32, 32), bool))[
        : camera.height, : camera.width
    ]

    region = Region(mask, RenderConfig())
    tenth = mi.TensorXf(region.crop(target))
    return {"step": step, "tenth_step": lambda: step(region, tenth)}


def measure(
    works: dict[str, Callable[[], Any]], repeats: int, patience: float = float("inf")
) -> dict[str, float]:
    """Return the median ms of every stage."""
    return {name: timed(work, repeats, patience) for name, work in works.items()}


def volprim_stages(gaussians: Gaussians, camera: Camera) -> dict[str, Callable[[], Any]]:
    """Return a step of Mitsuba's `volprim_rf_basic` on the same Gaussians, one sample per pixel."""
    scene: Any = mi.load_dict(
        {
            "type": "scene",
            "gaussians": ellipsoids(gaussians),
            "sensor": camera.sensor(),
            "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
        }
    )
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

    return {"volprim_step": step}


class Yardstick:
    """External program `BIN FILE.bin REPETITIONS THREADS` that prints the median time of its whole
    step.
    """

    def __init__(self, program: Path) -> None:
        self.program = program.resolve()

    def step(self, gaussians: Gaussians, camera: Camera, repeats: int) -> float:
        """Return the median time of the program's whole step, ms."""
        with tempfile.TemporaryDirectory() as folder:
            workload = Path(folder) / "workload.bin"
            write_bin(gaussians, camera, workload)
            command = [self.program, workload, str(repeats), str(dr.thread_count())]
            output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        match = re.search(r"fwd\+bwd ms: median ([\d.]+)", output)
        if not match:
            raise SystemExit(
                f"{self.program}: expected a line 'fwd+bwd ms: median ...', got {output!r}"
            )
        return float(match[1])

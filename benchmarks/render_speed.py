"""Time one optimisation step of the renderer on a workload, beside a yardstick if there is one.

    python benchmarks/render_speed.py --workload W1.npz --json out.json [--yardstick BIN]

A workload holds `means [N,3]`, `quats [N,4]` wxyz, `scales [N,3]`, `opacities [N]`, `colors [N,3]`, `K [3,3]`,
`viewmat [4,4]`, `width`, `height`. The whole step is: projection, lists, forward, L1 loss against a constant,
adjoint, the projection's adjoint, and the gradients of all attributes in memory. The yardstick is a program
`BIN FILE.bin REPETITIONS THREADS` that prints the median of its own whole step; the two are run in turns.
"""

from __future__ import annotations

import json
import platform
import re
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

import morgs_mi
from morgs_mi import Camera, Gaussians, rasterize
from morgs_mi.render.blocks import build_lists
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import project

TARGET = (0.4, 0.5, 0.6)
SH_C0 = 0.28209479177387814


@dataclass(frozen=True)
class Options:
    """What to time and where to write it."""

    workload: Path
    """File .npz, see the module docstring."""
    json: Path | None = None
    """Where the figures go; standard output if left out."""
    yardstick: Path | None = None
    """Program to run on the same workload."""
    repeats: int = 9
    """Timed repetitions per round; the median counts."""
    rounds: int = 3
    """Rounds; ours and the yardstick's take turns, so that both meet the same noise."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant."""


def load(path: Path) -> tuple[Gaussians, Camera]:
    """Return the workload's Gaussians, SH degree 0, and its camera."""
    z = np.load(path)
    sh = ((z["colors"] - 0.5) / SH_C0)[:, None, :]
    gaussians = Gaussians.from_activated(z["means"], z["scales"], z["quats"], z["opacities"], sh)
    return gaussians, Camera(z["K"], z["viewmat"].astype(float), int(z["width"]), int(z["height"]))


def timed(work: Any, repeats: int) -> float:
    """Return the median time of `work` in ms, synchronised, after two runs of warm-up."""
    times = []
    for _ in range(repeats + 2):
        dr.sync_thread()
        start = time.perf_counter()
        dr.eval(work())
        dr.sync_thread()
        times.append(1e3 * (time.perf_counter() - start))
    return median(times[2:])


def measure(gaussians: Gaussians, camera: Camera, repeats: int) -> dict[str, float]:
    """Return ms for lists (with projection), forward (with lists) and the whole step, and for tracing alone."""
    config, target = RenderConfig(), dr.opaque(mi.Float, 0)
    target = mi.TensorXf(np.broadcast_to(np.float32(TARGET), (camera.height, camera.width, 3)).copy())
    dr.enable_grad(*gaussians.items().values())

    def lists() -> Any:
        with dr.suspend_grad():
            built = build_lists(project(gaussians, camera, ("color",), config), camera.width, camera.height, config)
        return built.entries, built.order

    def forward() -> Any:
        with dr.suspend_grad():
            return rasterize(gaussians, camera, ("color",)).color

    def step() -> Any:
        image = rasterize(gaussians, camera, ("color",)).color
        dr.backward(dr.mean(dr.abs(image - target), axis=None))
        grads = [dr.grad(v) for v in gaussians.items().values()]
        dr.eval(grads)
        for value in gaussians.items().values():
            dr.clear_grad(value)
        return grads

    return {name: timed(work, repeats) for name, work in (("lists", lists), ("forward", forward), ("step", step))}


def write_bin(workload: Path, path: Path) -> None:
    """Write the workload in the yardstick's format."""
    z = np.load(workload)
    with path.open("wb") as file:
        np.array([len(z["means"]), z["width"], z["height"]], np.int32).tofile(file)
        for name in ("means", "quats", "scales", "opacities", "colors", "K", "viewmat"):
            z[name].astype(np.float32).tofile(file)
        np.float32([*TARGET, 0, 0, 0]).tofile(file)


def run_yardstick(program: Path, workload: Path, repeats: int, threads: int) -> float:
    """Return the yardstick's own median of its whole step in ms."""
    output = subprocess.run(
        [program.resolve(), workload, str(repeats), str(threads)], capture_output=True, text=True, check=True
    ).stdout
    found = re.search(r"fwd\+bwd ms: median ([\d.]+)", output)
    if not found:
        raise SystemExit(f"{program}: expected a line 'fwd+bwd ms: median ...', got {output!r}")
    return float(found[1])


def main(options: Options) -> None:
    """Run the rounds and write the medians."""
    mi.set_variant(options.variant)
    gaussians, camera = load(options.workload)
    threads = dr.thread_count()
    rounds: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / "workload.bin"
        write_bin(options.workload, binary)
        for _ in range(options.rounds):
            figures = measure(gaussians, camera, options.repeats)
            if options.yardstick:
                figures["yardstick_step"] = run_yardstick(options.yardstick, binary, options.repeats, threads)
            rounds.append(figures)

    result: dict[str, Any] = {f"{key}_ms": round(median(r[key] for r in rounds), 3) for key in rounds[0]}
    if options.yardstick:
        ratios = [r["step"] / r["yardstick_step"] for r in rounds]
        result["ratio_to_yardstick"] = round(median(ratios), 3)
        result["ratio_per_round"] = [round(r, 3) for r in ratios]
    result |= {
        "workload": options.workload.name,
        "gaussians": len(gaussians),
        "size": [camera.width, camera.height],
        "threads": threads,
        "machine": f"{platform.machine()}, {_cpu()}",
        "versions": {"mitsuba": mi.__version__, "drjit": dr.__version__, "python": platform.python_version()},
        "variant": options.variant,
        "package": morgs_mi.__name__,
    }
    text = json.dumps(result, indent=2)
    if options.json:
        options.json.write_text(text + "\n")
    print(text)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    main(tyro.cli(Options))

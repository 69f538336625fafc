"""Time the renderer: one optimisation step on a workload, compared with baselines.

    python -m benchmarks.speed.render_speed --workload W1.npz --json out.json [--yardstick BIN]
    [--baselines]

The whole step is: projection, lists, forward, L1 loss against a constant, adjoint, the projection's
adjoint, and the gradients of all attributes in memory; the optimised step has Adam's step, too. All
programs run in turn: background load affects them equally, so compare ratios.
"""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import tyro

import morgs_mi
from benchmarks import workloads
from benchmarks.speed import timing
from morgs_mi import Camera, Gaussians
from morgs_mi.core.environment import machine, versions


@dataclass(frozen=True)
class Options:
    """Workload, programs and output."""

    workload: Path
    """Workload file, .npz."""
    json: Path | None = None
    """JSON file for the figures, which are also printed."""
    yardstick: Path | None = None
    """Program to compare with on the same workload."""
    repeats: int = 9
    """Timed repetitions per round; medians are reported."""
    rounds: int = 3
    """Number of rounds, in each of which the renderer, the yardstick and the baselines run in turn.
    """
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant."""
    baselines: bool = False
    """Whether to also time Mitsuba's volprim_rf_basic."""
    seed: int = 1
    """Seed of the pixels for measuring the error."""


def figures(gaussians: Gaussians, camera: Camera, options: Options) -> dict[str, Any]:
    """Return medians over the rounds, their ratios, memory and error."""
    ours = timing.stages(gaussians, camera)
    memory = timing.peak_megabytes(ours["step"])  # before the other stages allocate memory
    others, left_out = timing.baselines(gaussians, camera) if options.baselines else ({}, {})
    yardstick = timing.Yardstick(options.yardstick) if options.yardstick else None
    rounds: list[dict[str, float]] = []
    for _ in range(options.rounds):
        row = timing.measure(ours, options.repeats)
        if yardstick:
            row["yardstick_step"] = yardstick.step(gaussians, camera, options.repeats)
        # The baselines take a hundred times longer; one run is precise enough.
        row |= timing.measure(others, options.repeats, patience=0.5)
        rounds.append(row)

    result: dict[str, Any] = {
        f"{key}_ms": round(median(r[key] for r in rounds), 3) for key in rounds[0]
    }
    for key in ("yardstick_step", "volprim_step"):
        if key in rounds[0]:
            ratios = [r["step"] / r[key] for r in rounds]
            # Ratios to the slow baselines need four decimals.
            result[f"ratio_to_{key.removesuffix('_step')}"] = round(
                median(ratios), 3 if key == "yardstick_step" else 4
            )
            if key == "yardstick_step":
                result["ratio_per_round"] = [round(r, 3) for r in ratios]
    for key, share, whole in (
        ("tenth_share", "tenth_step", "step"),
        ("loss_share", "loss", "forward"),
    ):
        if share in rounds[0]:
            result[key] = round(median(r[share] / r[whole] for r in rounds), 3)
    if left_out:
        result["left_out"] = left_out
    result["peak_megabytes"] = memory
    result |= timing.extent(gaussians, camera)
    return result | timing.error(gaussians, camera, options.seed)


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant(options.variant)
    gaussians, camera = workloads.load(options.workload)
    result = figures(gaussians, camera, options) | {
        "workload": options.workload.name,
        "gaussians": len(gaussians),
        "size": [camera.width, camera.height],
        "threads": dr.thread_count(),
        "machine": f"{platform.machine()}, {machine()['processor']}",
        "versions": versions(),
        "variant": options.variant,
        "package": morgs_mi.__name__,
    }
    text = json.dumps(result, indent=2)
    if options.json:
        options.json.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Time the renderer: one optimisation step on a workload, compared with baselines.

    python -m benchmarks.speed.render_speed --workload W1.npz --json out.json [--yardstick BIN]
    [--baselines]

The whole step is: projection, lists, forward, L1 loss against a constant, adjoint, the projection's
adjoint, and the gradients of all attributes in memory. All programs run in turn: background load
affects them equally, so compare ratios.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import mitsuba as mi
import tyro

from benchmarks import workloads
from benchmarks.speed import timing
from benchmarks.speed.output import Output
from morgs_mi import Camera, Gaussians

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


def figures(gaussians: Gaussians, camera: Camera, options: Options) -> dict[str, Any]:
    """Return medians over the rounds, and their ratios."""
    ours = timing.stages(gaussians, camera)
    others = timing.volprim_stages(gaussians, camera) if options.baselines else {}
    yardstick = timing.Yardstick(options.yardstick) if options.yardstick else None
    rounds: list[dict[str, float]] = []
    for _ in range(_ROUNDS):
        row = timing.measure(ours, _REPEATS)
        if yardstick:
            row["yardstick_step"] = yardstick.step(gaussians, camera, _REPEATS)
        # The baselines take a hundred times longer; one run is precise enough.
        row |= timing.measure(others, _REPEATS, patience=0.5)
        rounds.append(row)

    result: dict[str, Any] = {
        f"{key}_ms": round(median(r[key] for r in rounds), 3) for key in rounds[0]
    }
    if yardstick:
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

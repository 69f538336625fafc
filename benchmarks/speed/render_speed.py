"""Time the renderer: one optimisation step on a workload, or on a ladder of sizes, compared with baselines.

    python -m benchmarks.speed.render_speed --workload W1.npz --json out.json [--yardstick BIN] [--baselines]
    python -m benchmarks.speed.render_speed [--quick] --json out.json --csv out.csv --plot out.png [--baselines]

The whole step is: projection, lists, forward, L1 loss against a constant, adjoint, the projection's adjoint, and the
gradients of all attributes in memory; the optimised step has Adam's step, too. All programs run in turn, so that
background load affects them equally: compare ratios. Without `--workload` a ladder of workloads varies one property at
a time: number of Gaussians, image size, size of the splats, channels.
"""

from __future__ import annotations

import csv
import json
import platform
from dataclasses import dataclass, replace
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
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.render.channels import channel_sizes


@dataclass(frozen=True)
class Options:
    """Workloads, programs and output."""

    workload: Path | None = None
    """Workload file, .npz; default is the ladder."""
    json: Path | None = None
    """JSON file for the figures; default is standard output."""
    yardstick: Path | None = None
    """Program to compare with on the same workloads."""
    repeats: int = 9
    """Timed repetitions per round; medians are reported."""
    rounds: int = 3
    """Number of rounds, in each of which the renderer, the yardstick and the baselines run in turn."""
    variant: str = "llvm_ad_rgb"
    """Mitsuba variant."""
    baselines: bool = False
    """Whether to also time Mitsuba's volprim_rf_basic and a renderer with one lane per pixel."""
    quick: bool = False
    """Whether to run a short ladder of less than a minute."""
    csv: Path | None = None
    """CSV file for the ladder."""
    plot: Path | None = None
    """Plot of the ladder; needs matplotlib."""
    seed: int = 1
    """Seed of the ladder's Gaussians and of the pixels whose error is measured."""


def figures(
    gaussians: Gaussians,
    camera: Camera,
    channels: tuple[str, ...],
    options: Options,
    patience: float = float("inf"),
    num_features: int = 0,
) -> dict[str, Any]:
    """Return medians over the rounds, their ratios, memory and error for one workload."""
    ours = timing.stages(gaussians, camera, channels, num_features)
    memory = timing.peak_megabytes(ours["step"])  # before the other stages allocate memory
    others, left_out = timing.baselines(gaussians, camera, channels) if options.baselines else ({}, {})
    yardstick = timing.Yardstick(options.yardstick) if options.yardstick and channels == ("color",) else None
    rounds: list[dict[str, float]] = []
    for _ in range(options.rounds):
        row = timing.measure(ours, options.repeats, patience)
        if yardstick:
            row["yardstick_step"] = yardstick.step(gaussians, camera, options.repeats)
        # The baselines take a hundred times longer; one run is precise enough.
        row |= timing.measure(others, options.repeats, patience=0.5)
        rounds.append(row)

    result: dict[str, Any] = {f"{key}_ms": round(median(r[key] for r in rounds), 3) for key in rounds[0]}
    for key in ("yardstick_step", "plain_step", "volprim_step"):
        if key in rounds[0]:
            ratios = [r["step"] / r[key] for r in rounds]
            # Ratios to the slow baselines need four decimals.
            result[f"ratio_to_{key.removesuffix('_step')}"] = round(median(ratios), 3 if key == "yardstick_step" else 4)
            if key == "yardstick_step":
                result["ratio_per_round"] = [round(r, 3) for r in ratios]
    for key, share, whole in (("tenth_share", "tenth_step", "step"), ("loss_share", "loss", "forward")):
        if share in rounds[0]:
            result[key] = round(median(r[share] / r[whole] for r in rounds), 3)
    if left_out:
        result["left_out"] = left_out
    result["peak_megabytes"] = memory
    result |= timing.extent(gaussians, camera)
    return result | timing.error(gaussians, camera, options.seed)


def time_workload(path: Path, options: Options) -> dict[str, Any]:
    """Return the figures of one workload file."""
    gaussians, camera = workloads.load(path)
    return figures(gaussians, camera, ("color",), options) | {
        "workload": path.name,
        "gaussians": len(gaussians),
        "size": [camera.width, camera.height],
        "threads": dr.thread_count(),
        "machine": f"{platform.machine()}, {machine()['processor']}",
        "versions": versions(),
        "variant": options.variant,
        "package": morgs_mi.__name__,
    }


def climb(options: Options) -> dict[str, Any]:
    """Return the figures of every rung of the ladder."""
    if options.quick:
        options = replace(options, rounds=min(options.rounds, 2), repeats=min(options.repeats, 5))
    rows = []
    for rung in workloads.QUICK if options.quick else workloads.FULL:
        gaussians, camera = workloads.build(rung, options.seed)
        row: dict[str, Any] = {"name": rung.name, "series": rung.series, "gaussians": rung.count}
        row |= {"size": list(rung.size), "scale": rung.scale, "channels": list(rung.channels)}
        row |= {"columns": rung.features + sum(channel_sizes().get(name, 0) for name in rung.channels)}
        patience = 0.7 if options.quick else 2
        row |= figures(gaussians, camera, rung.channels, options, patience, rung.features)
        print(
            f"{rung.name:30s} lists {row['lists_ms']:8.1f}  forward {row['forward_ms']:8.1f}  "
            f"step {row['step_ms']:8.1f} ms  {row['peak_megabytes']:8.1f} MB  error {row['error_max']:.1e}",
            flush=True,
        )
        rows.append(row)
    return {"rungs": rows, "seed": options.seed, "threads": dr.thread_count(), "machine": machine()} | {
        "versions": versions()
    }


def write_csv(rows: list[dict[str, Any]], path: Path) -> None:
    """Write one line per rung; lists are joined by spaces, missing figures are empty."""
    names = list(dict.fromkeys(name for row in rows for name in row if name not in ("left_out", "ratio_per_round")))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: " ".join(map(str, v)) if isinstance(v, list) else v for k, v in row.items()})


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Plot time and memory over the pixels on the lists, log-log."""
    from matplotlib.figure import Figure

    overhead = [row["step_ms"] for row in rows if row.get("series") == "overhead"]
    rows = [row for row in rows if row.get("series") != "overhead"] or rows
    figure = Figure(figsize=(13, 5.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    x = [row["listed_megapixels"] for row in rows]
    for key, mark in (
        ("lists", "v"),
        ("forward", "o"),
        ("adjoint", "^"),
        ("step", "s"),
        ("yardstick_step", "x"),
        ("plain_step", "+"),
        ("volprim_step", "*"),
    ):
        points = [(a, row[f"{key}_ms"]) for a, row in zip(x, rows, strict=True) if f"{key}_ms" in row]
        if points:
            left.plot(*zip(*sorted(points), strict=True), mark, label=key.replace("_", ", "), linestyle="none")
    largest = max(rows, key=lambda row: row["step_ms"])
    slope = largest["step_ms"] / largest["listed_megapixels"]
    left.plot([min(x), max(x)], [slope * min(x), slope * max(x)], "k:", linewidth=1, label="linear")
    if overhead:
        left.axhline(overhead[0], color="C2", linestyle="--", linewidth=1, label="step of the smallest workload")
    right.plot(x, [row["peak_megabytes"] for row in rows], "s", color="C4", label="peak of a step, Dr.Jit")
    right.plot(x, [1e-6 * row["list_bytes"] for row in rows], "v", color="C0", label="lists")
    for axis, key in ((left, "step_ms"), (right, "peak_megabytes")):
        for a, row in zip(x, rows, strict=True):
            axis.annotate(row["name"], (a, row[key]), xytext=(5, 4), textcoords="offset points", fontsize=7)
        axis.set(xscale="log", yscale="log", xlabel="pixels that the listed Gaussians may touch, millions")
        axis.margins(0.12)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1))
    left.set_ylabel("ms")
    right.set_ylabel("MB")
    figure.savefig(path, dpi=85)


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant(options.variant)
    result = time_workload(options.workload, options) if options.workload else climb(options)
    text = json.dumps(result, indent=2)
    if options.json:
        options.json.write_text(text + "\n")
    if options.workload or not options.json:
        print(text)
    if options.csv:
        write_csv(result.get("rungs", [result]), options.csv)
    if options.plot:
        plot(result.get("rungs", [{**result, "name": result.get("workload")}]), options.plot)


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Number of Gaussians and steps of the first frame: chosen from the capture, against fixed ones.

    python -m benchmarks.reports.first_frame --seeds 6 7 8 --captures CAPTURE --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`; of further captures, reduced by `--downscale`,
no view is held out. The probability of dropping is chosen as by default.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import tyro

from benchmarks.reports.generalise import first_frame
from benchmarks.reports.random_scenes import random_capture
from benchmarks.speed.output import Output
from morgs_mi.calibration.rig_check import dense_points, match_capture
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.fit.config import FitConfig


@dataclass(frozen=True)
class Options(Output):
    """Clips and output."""

    seeds: tuple[int, ...] = (6, 7, 8)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    captures: tuple[Path, ...] = ()
    """Further captures without points."""
    downscale: float = 4
    """Factor by which these are reduced."""
    gaussians: int = 20_000
    """Fixed number of Gaussians."""
    steps: int = 1500
    """Fixed number of steps."""
    compare: bool = True
    """Whether to fit with the fixed numbers too."""
    dropping: tuple[float, ...] = ()
    """Probability of dropping of each clip; none: chosen."""


def measure(capture: Capture, fit: FitConfig) -> dict[str, float]:
    """Fit the first frame and return its size, its steps, its time, and the PSNR of trained and held-out views."""
    train = capture.train_views
    scores, report = first_frame(capture, train, replace(StreamConfig(), fit=fit))
    figures = {
        "gaussians": report.num_gaussians,
        "steps": report.steps,
        "seconds": round(report.seconds, 1),
        "training": round(float(scores[list(train)].mean()), 2),
    }
    if capture.test_view is not None:
        figures["held_out"] = round(float(scores[capture.test_view]), 2)
    return figures


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    captures = [random_capture(options.clips, seed) for seed in options.seeds]
    for path in options.captures:
        capture = load_capture(path, options.downscale, None, 1)
        captures.append(dense_points(capture, match_capture(capture)))
    rows: dict[str, Any] = {}
    for k, capture in enumerate(captures):
        chosen = FitConfig(dropping=options.dropping[k] if options.dropping else None)
        fixed = replace(chosen, num_gaussians=options.gaussians, first_frame_steps=options.steps)
        name = capture.path.name
        rows[name] = {"views": len(capture.train_views)}
        for how, fit in {"chosen": chosen, **({"fixed": fixed} if options.compare else {})}.items():
            rows[name][how] = measure(capture, fit)
            print(name, how, rows[name][how], flush=True)
    options.write({"fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

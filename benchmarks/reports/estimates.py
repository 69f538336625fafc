"""Estimate of views between the cameras, as `fit` prints it, against the PSNR of held-out views.

    python -m benchmarks.reports.estimates --seeds 3 4 5 6 7 8 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`, reduced by `--downscale`. Some cameras that are
spread over the rig are trained on, and all others are held out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.few_views import spread_views
from benchmarks.reports.generalise import first_frame
from benchmarks.reports.random_scenes import random_capture
from benchmarks.speed.output import Output
from morgs_mi.config import StreamConfig


@dataclass(frozen=True)
class Options(Output):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 4, 5, 6, 7, 8)
    """Seeds of the scenes."""
    views: tuple[int, ...] = (4, 6, 8, 10)
    """Numbers of training views; those that a clip has not are skipped."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    downscale: float = 2
    """Factor by which the clips are reduced."""
    steps: int = 600
    """Steps of the first frame."""
    gaussians: int = 5000
    """Number of Gaussians."""
    compare_views: int = 1000
    """Number of views below which two fits are compared."""


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    trials = replace(config.fit.cross_validation, compare_views=options.compare_views)
    fit = replace(config.fit, first_frame_steps=options.steps, num_gaussians=options.gaussians, cross_validation=trials)
    rows = []
    for seed in options.seeds:
        capture = random_capture(options.clips, seed, options.downscale)
        others = capture.train_views
        for count in (n for n in options.views if n < len(capture.cameras) - 1):
            train = [others[k] for k in spread_views([capture.cameras[v] for v in others], count)]
            scores, report = first_frame(capture, train, replace(config, fit=fit))
            found = report.validation
            held_out = np.delete(scores, train)
            rows.append(
                {
                    "seed": seed,
                    "views": count,
                    "training": round(float(scores[train].mean()), 2),
                    "held_out": round(float(held_out.mean()), 2),
                    "worst": round(float(held_out.min()), 2),
                    "estimate": round(found["expected_psnr"], 2),
                    "trial": max(found.get("trials", ()), key=lambda trial: trial["withheld_psnr"], default=None),
                    "seconds": round(report.seconds, 1),
                }
            )
            print(rows[-1], flush=True)
    given = {"downscale": options.downscale, "steps": options.steps, "gaussians": options.gaussians}
    options.write({**given, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

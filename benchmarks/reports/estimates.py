"""Estimate of views between the cameras, as `fit` prints it, against the PSNR of held-out views.

    python -m benchmarks.reports.estimates --seeds 3 4 5 6 7 8 --fit-seeds 0 1 2 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`, reduced by `--downscale`. Some cameras that are
spread over the rig are trained on, and all others are held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.few_views import spread_views
from benchmarks.reports.fits import first_frame, random_capture
from benchmarks.reports.plots import grouped, markdown, plus_minus
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig


@dataclass(frozen=True)
class Options(CellOptions):
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
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each rig."""


def measure(source: Source, train: Sequence[int], config: StreamConfig) -> dict[str, Any]:
    """Return the PSNR of training and held-out views, the estimate, and what it follows from."""
    train = list(train)
    scores, report = first_frame(source.open(), train, config)
    held_out, found = np.delete(scores, train), report.validation
    return {
        "training": round(float(scores[train].mean()), 2),
        "held_out": round(float(held_out.mean()), 2),
        "worst": round(float(held_out.min()), 2),
        "estimate": round(found["expected_psnr"], 2),
        **{key: found[key] for key in ("spacing", "withheld_angle", "trials") if key in found},
        "seconds": round(report.seconds, 1),
    }


def estimates_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the PSNR of training and held-out views and the estimate by clip and number of views, in Markdown."""
    rows = []
    for (seed, views), own in grouped(fits, "seed", "views").items():
        means = (np.mean([fit[key] for fit in own]) for key in ("training", "held_out", "worst", "estimate"))
        errors = [fit["estimate"] - fit["held_out"] for fit in own]
        rows.append((f"{seed}", f"{views}", *(f"{mean:.1f} dB" for mean in means), f"{plus_minus(errors, 1)} dB"))
    titles = "training views", "held-out views", "worst one", "estimate", "error"
    return markdown(("seed", "views", *titles), rows)


def within(fits: Sequence[Mapping[str, Any]], limit: float) -> tuple[int, int]:
    """Return how many estimates are at most `limit` dB off, and how many there are."""
    return sum(abs(fit["estimate"] - fit["held_out"]) <= limit for fit in fits), len(fits)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    fit = replace(config.fit, first_frame_steps=options.steps, num_gaussians=options.gaussians)
    about, cells = {}, {}
    for seed in options.seeds:
        capture = random_capture(options.clips, seed, options.downscale)
        for count in (n for n in options.views if n < len(capture.cameras) - 1):
            train = spread_views(capture.cameras, count, capture.train_views)
            for fit_seed in options.fit_seeds:
                name = f"seed {seed}, {count} views, fit {fit_seed}"
                cells[name] = Source.of(capture), train, replace(config, seed=fit_seed, fit=fit)
                about[name] = {"seed": seed, "views": count, "fit_seed": fit_seed}
    rows = [{**about[name], **row} for name, row in options.run(measure, cells).items()]
    given = {"downscale": options.downscale, "steps": options.steps, "gaussians": options.gaussians}
    options.write({**given, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

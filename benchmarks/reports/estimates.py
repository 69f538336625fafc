"""Estimate of views between the cameras, as `fit` prints it, against the PSNR of held-out views.

    python -m benchmarks.reports.estimates --seeds 3 4 5 6 7 8 --fit-seeds 0 1 2 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`, reduced by `--downscale`. Some cameras that are
spread over the rig are trained on, and all others are held out. Two fits are compared for every number of views.
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
from benchmarks.reports.plots import markdown, plus_minus
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.fit.agreement import Agreement
from morgs_mi.fit.cross_validation import CrossValidation, Trial
from morgs_mi.fit.first_settings import Expected


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


def estimates(found: dict[str, Any]) -> dict[str, float]:
    """Return the PSNR that each way expects, from the report of a first frame."""
    training = found["training_psnr"]
    expected: dict[str, Expected] = {"two_fits": Agreement(0, 0.0, tuple(found["differences"]), training)}
    if "trials" in found:
        trials = tuple(Trial(**trial) for trial in found["trials"])
        expected["withheld_views"] = CrossValidation((), 0.0, trials, training)
    return {name: round(each.expected_psnr or 0.0, 2) for name, each in expected.items()}


def measure(source: Source, train: Sequence[int], config: StreamConfig, compare_views: int) -> dict[str, float]:
    """Return the PSNR of training and held-out views, and the estimates.

    Args:
        source: the capture.
        train: indices of the training views.
        config: settings.
        compare_views: number of views from which on `fit` does not compare two fits.
    """
    train = list(train)
    scores, report = first_frame(source.open(), train, config)
    held_out, expected = np.delete(scores, train), estimates(report.validation)
    printed = [psnr for how, psnr in expected.items() if how != "two_fits" or len(train) < compare_views]
    return {
        "training": round(float(scores[train].mean()), 2),
        "held_out": round(float(held_out.mean()), 2),
        "worst": round(float(held_out.min()), 2),
        **expected,
        "estimate": max(printed),
        "seconds": round(report.seconds, 1),
    }


def estimates_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the PSNR of held-out views and its estimates by clip and number of views, in Markdown."""
    rigs: dict[tuple[int, int], list[Mapping[str, Any]]] = {}
    for fit in fits:
        rigs.setdefault((fit["seed"], fit["views"]), []).append(fit)
    rows = []
    for (seed, views), own in rigs.items():
        keys = ("training", "held_out", "worst", "two_fits", "withheld_views")
        cells = (f"{np.mean([fit[key] for fit in own]):.1f} dB" if key in own[0] else "-" for key in keys)
        errors = [fit["estimate"] - fit["held_out"] for fit in own]
        rows.append((f"{seed}", f"{views}", *cells, f"{plus_minus(errors, 1)} dB"))
    titles = "training views", "held-out views", "worst one", "two fits", "withheld views", "error"
    return markdown(("seed", "views", *titles), rows)


def within(fits: Sequence[Mapping[str, Any]], limit: float) -> tuple[int, int]:
    """Return how many estimates are at most `limit` dB off, and how many there are."""
    return sum(abs(fit["estimate"] - fit["held_out"]) <= limit for fit in fits), len(fits)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    compare_views = config.fit.cross_validation.compare_views
    trials = replace(config.fit.cross_validation, compare_views=1000)
    fit = replace(config.fit, first_frame_steps=options.steps, num_gaussians=options.gaussians, cross_validation=trials)
    about, cells = {}, {}
    for seed in options.seeds:
        capture = random_capture(options.clips, seed, options.downscale)
        for count in (n for n in options.views if n < len(capture.cameras) - 1):
            train = spread_views(capture.cameras, count, capture.train_views)
            for fit_seed in options.fit_seeds:
                name = f"seed {seed}, {count} views, fit {fit_seed}"
                cells[name] = Source.of(capture), train, replace(config, seed=fit_seed, fit=fit), compare_views
                about[name] = {"seed": seed, "views": count, "fit_seed": fit_seed}
    rows = [{**about[name], **row} for name, row in options.run(measure, cells).items()]
    given = {"downscale": options.downscale, "steps": options.steps, "gaussians": options.gaussians}
    options.write({**given, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

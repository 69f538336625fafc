"""First frames with and without cross-validation: quality of the held-out view, and the estimate of it.

    python -m benchmarks.reports.generalise --seeds 3 4 5 6 7 8 --fit-seeds 0 1 2 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`. The first frame is fitted as by default, where
cross-validation or the noise of few views chooses the probability of dropping, and without dropping.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import first_frame, random_capture
from benchmarks.reports.plots import grouped, markdown, plus_minus
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.fit.dropping import dropping_by_noise


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips and output."""

    seeds: tuple[int, ...] = (3, 4, 5, 6, 7, 8)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    steps: int = 1500
    """Steps of the first frame."""
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each clip."""


def measure(source: Source, config: StreamConfig) -> dict[str, Any]:
    """Fit the first frame; return PSNR of the held-out view and the training views, and what was chosen and expected.

    `estimate` is what `fit` expects of views between the cameras, None where dropping is given.
    """
    capture = source.open()
    train, test = list(capture.train_views), capture.test_view
    assert test is not None
    scores, report = first_frame(capture, train, config)
    trials, dropping = report.validation.get("trials"), config.fit.dropping
    if trials:
        dropping = max(trials, key=lambda trial: trial["withheld_psnr"])["dropping"]
    elif dropping is None:
        images = next(capture.frames(0, 1)).images
        dropping = dropping_by_noise([images[v] for v in train])
    return {
        "held_out": round(float(scores[test]), 2),
        "training": round(float(scores[train].mean()), 2),
        "dropping": dropping,
        "estimate": report.validation.get("expected_psnr"),
        "gaussians": report.num_gaussians,
        "seconds": round(report.seconds, 1),
    }


def choice_table(fits: Sequence[Mapping[str, Any]]) -> str:
    """Return the held-out PSNR of each clip without dropping and with the chosen strength, in Markdown."""
    rows = []
    for (seed,), own in grouped(fits, "seed").items():
        chosen = [fit["chosen"] for fit in own]
        without = plus_minus([fit["without"]["held_out"] for fit in own])
        strengths = ", ".join(f"{strength:g}" for strength in sorted({each["dropping"] for each in chosen}))
        with_it = plus_minus([each["held_out"] for each in chosen])
        row = f"{without} dB", strengths, f"{with_it} dB"
        rows.append((f"{seed}", f"{own[0]['views']}", f"{chosen[0]['gaussians']:,}", *row))
    return markdown(("seed", "training views", "Gaussians", "p = 0", "chosen p", "with it"), rows)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    config = replace(config, fit=replace(config.fit, first_frame_steps=options.steps))
    settings = {"without": replace(config, fit=replace(config.fit, dropping=0.0)), "chosen": config}
    about, cells = {}, {}
    for seed, fit_seed in product(options.seeds, options.fit_seeds):
        capture, name = random_capture(options.clips, seed), f"seed {seed}, fit {fit_seed}"
        about[name] = {"seed": seed, "fit_seed": fit_seed, "views": len(capture.train_views)}
        for how, each in settings.items():
            cells[f"{name}, {how}"] = Source.of(capture), replace(each, seed=fit_seed)
    found = options.run(measure, cells)
    rows = [{**row, **{how: found[f"{name}, {how}"] for how in settings}} for name, row in about.items()]
    options.write({"steps": options.steps, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

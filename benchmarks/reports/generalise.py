"""First frames with and without cross-validation: quality of the held-out view, and the estimate of it.

    python -m benchmarks.reports.generalise --seeds 3 4 5 6 7 8 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`. The first frame is fitted as by default, where
cross-validation chooses the probability of dropping, and without dropping.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import first_frame, random_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips and output."""

    seeds: tuple[int, ...] = (3, 4, 5, 6, 7, 8)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    steps: int = 1500
    """Steps of the first frame."""


def measure(source: Source, config: StreamConfig) -> dict[str, float]:
    """Fit the first frame; return PSNR of the held-out view and of the training views, seconds, and the estimate."""
    capture = source.open()
    train, test = capture.train_views, capture.test_view
    assert test is not None
    scores, report = first_frame(capture, train, config)
    figures = {
        "held_out": float(scores[test]),
        "training": float(scores[list(train)].mean()),
        "seconds": report.seconds,
    }
    if "trials" not in report.validation:
        return figures
    best = max(report.validation["trials"], key=lambda trial: trial["withheld_psnr"])
    return {**figures, "dropping": best["dropping"], "estimate": best["withheld_psnr"]}


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    config = replace(config, fit=replace(config.fit, first_frame_steps=options.steps))
    settings = {"without": replace(config, fit=replace(config.fit, dropping=0.0)), "chosen": config}
    captures = {seed: random_capture(options.clips, seed) for seed in options.seeds}
    cells = {
        f"{seed} {how}": (Source.of(capture), each)
        for seed, capture in captures.items()
        for how, each in settings.items()
    }
    found = options.run(measure, cells)
    rows = {
        str(seed): {"views": len(capture.train_views), **{how: found[f"{seed} {how}"] for how in settings}}
        for seed, capture in captures.items()
    }
    options.write({"steps": options.steps, "seeds": rows}, unprinted=["seeds"])


if __name__ == "__main__":
    main(tyro.cli(Options))

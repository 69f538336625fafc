"""The first frame with few steps: all Gaussians, or half of them with the steps that the same time allows.

    python -m benchmarks.reports.few_steps --seeds 16 17 18 --json few_steps.json

The clips are those of `random_scenes`, at two thirds of their size. Both are what `--first-frame-seconds` chooses
between where it allows 100 steps with all Gaussians (`morgs_mi.fit.budget`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import first_frame, random_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig

CHOICES = {"all": (20_000, 100), "half": (10_000, 150)}
"""Gaussians and steps."""


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips and output."""

    seeds: tuple[int, ...] = (16, 17, 18)
    """Seeds of the scenes."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits."""
    clips: Path = Path("out/random")
    """Folder of the clips."""


def measure(source: Source, config: StreamConfig) -> dict[str, float]:
    """Return the mean PSNR of the held-out views, dB, and the processor time, s."""
    capture, start = source.open(), time.process_time()
    scores, _ = first_frame(capture, capture.train_views, config)
    seconds = time.process_time() - start
    return {"held_out": round(float(np.delete(scores, capture.train_views).mean()), 2), "cpu_s": round(seconds, 2)}


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    cells = {}
    for scene, (name, (count, steps)), seed in product(options.seeds, CHOICES.items(), options.fit_seeds):
        config = StreamConfig(seed=seed)
        fit = replace(config.fit, num_gaussians=count, first_frame_steps=steps, dropping=0.0)
        source = Source.of(random_capture(options.clips, scene, 1.5))
        cells[f"{scene}; {name}; {seed}"] = source, replace(config, fit=fit)
    options.write({"fits": options.run(measure, cells)}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

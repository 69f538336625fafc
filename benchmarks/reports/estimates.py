"""Estimate of views between the cameras, as `fit` prints it, against the PSNR of held-out views.

    python -m benchmarks.reports.estimates --seeds 3 4 5 6 7 8 --fit-seeds 0 1 2 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`, reduced by `--downscale`. Some cameras that are
spread over the rig are trained on, and all others are held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from benchmarks.reports.fits import RandomOptions, first_frame, random_capture
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi.core.camera import Camera
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.tasks import Source

COLUMNS = (
    Column("training views", "training", 1, unit=" dB", spread=False),
    Column("held-out views", "held_out", 1, unit=" dB", spread=False),
    Column("worst one", "worst", 1, unit=" dB", spread=False),
    Column("estimate", "estimate", 1, unit=" dB", spread=False),
    Column("error", lambda fit: fit["estimate"] - fit["held_out"], 1, unit=" dB"),
)


@dataclass(frozen=True)
class Options(RandomOptions):
    """Clips, work and output."""

    views: tuple[int, ...] = (4, 6, 8, 10)
    """Numbers of training views; those that a clip has not are skipped."""
    gaussians: int | None = 5000
    """Number of Gaussians."""

    def study(self) -> Study:
        """Return the study of the clips with the numbers of training views."""
        scenes = []
        for seed in self.seeds:
            capture = random_capture(self.clips, seed, self.downscale)
            for count in (n for n in self.views if n < len(capture.cameras) - 1):
                train = spread_views(capture.cameras, count, capture.train_views)
                scenes.append(Scene({"seed": seed, "views": count}, (Source.of(capture), train)))
        return Study(measure, scenes, [Variant({}, self.config())], self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the estimates, and how many of them are right."""
        right, count = within(rows, 1.5)
        return f"{estimates_table(rows)}\n{right} of {count} estimates are within 1.5 dB.\n"


def spread_views(cameras: Sequence[Camera], count: int, among: Sequence[int]) -> tuple[int, ...]:
    """Return the indices of `count` of the cameras `among` all that are far from each other."""
    positions = np.array([cameras[v].position for v in among])
    chosen = [int(np.argmax(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))]
    while len(chosen) < count:
        distance = np.linalg.norm(positions[:, None] - positions[chosen], axis=-1).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return tuple(sorted(among[k] for k in chosen))


def measure(source: Source, train: Sequence[int], config: StreamConfig) -> dict[str, Any]:
    """Return the PSNR of training and held-out views, the estimate, and what it follows from."""
    scores, report = first_frame(source.open(), train, config)
    held_out, found = np.delete(scores, train), report.validation
    return {
        "training": scores[list(train)].mean(),
        "held_out": held_out.mean(),
        "worst": held_out.min(),
        "estimate": found["expected_psnr"],
        **{key: found[key] for key in ("spacing", "withheld_angle", "trials") if key in found},
        "seconds": report.seconds,
    }


def estimates_table(fits: Sequence[Row]) -> str:
    """Return the PSNR of training and held-out views and the estimate by clip and number of views, in Markdown."""
    return scores_table(fits, {"seed": "seed", "views": "views"}, COLUMNS)


def within(fits: Sequence[Row], limit: float) -> tuple[int, int]:
    """Return how many estimates are at most `limit` dB off, and how many there are."""
    return sum(abs(fit["estimate"] - fit["held_out"]) <= limit for fit in fits), len(fits)


if __name__ == "__main__":
    tyro.cli(Options).run()

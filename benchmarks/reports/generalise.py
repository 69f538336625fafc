"""First frames with and without cross-validation: quality of the held-out view, and the estimate of it.

    python -m benchmarks.reports.generalise --seeds 3 4 5 6 7 8 --fit-seeds 0 1 2 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`. The first frame is fitted as by default, where
cross-validation or the noise of few views chooses the probability of dropping, and without dropping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import tyro

from benchmarks.reports.fits import RandomOptions, first_frame, random_capture
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi.fit.dropping import dropping_by_noise
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.tasks import Source

_WITHOUT, _CHOSEN = {"variant": "without"}, {"variant": "chosen"}
COLUMNS = (
    Column("Gaussians", "gaussians", 0, spread=False, only=_CHOSEN),
    Column("p = 0", "held_out", unit=" dB", only=_WITHOUT),
    Column("chosen p", "dropping", only=_CHOSEN),
    Column("with it", "held_out", unit=" dB", only=_CHOSEN),
)


@dataclass(frozen=True)
class Options(RandomOptions):
    """Clips and output."""

    downscale: float = 1
    """Factor by which the clips are reduced."""
    steps: int = 1500
    """Steps of the first frame."""

    def study(self) -> Study:
        """Return the study of the clips without dropping and with the chosen probability."""
        captures = {seed: random_capture(self.clips, seed, self.downscale) for seed in self.seeds}
        scenes = [Scene({"seed": s, "views": len(c.train_views)}, (Source.of(c),)) for s, c in captures.items()]
        variants = [Variant(_WITHOUT, self.config(dropping=0.0)), Variant(_CHOSEN, self.config())]
        return Study(measure, scenes, variants, self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the held-out PSNR of each clip without dropping and with the chosen probability."""
        return scores_table(rows, {"seed": "seed", "training views": "views"}, COLUMNS)


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
        "held_out": scores[test],
        "training": scores[train].mean(),
        "dropping": dropping,
        "estimate": report.validation.get("expected_psnr"),
        "gaussians": report.num_gaussians,
        "seconds": report.seconds,
    }


if __name__ == "__main__":
    tyro.cli(Options).run()

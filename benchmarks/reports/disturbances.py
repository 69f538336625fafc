"""Fits of an animated glTF model that is recorded with disturbances, against the exact ground truth.

    python -m benchmarks.reports.disturbances fox.glb --json out.json

Each clip is the same animation from the same cameras with one kind of disturbance. Scores are means over the later
frames of the held-out view, which is the reference: it has no time offset, and the right exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from tyro.conf import Positional

from benchmarks.reports.fits import ClipOptions
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.random_scenes import measure
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi.runs.cluster.tasks import Source
from morgs_mi.synth.disturbances import Disturbances

DISTURBANCES = {
    "none": Disturbances(),
    "time offset": Disturbances(time_offset=0.5),
    "rolling shutter": Disturbances(rolling_shutter=0.5),
    "exposure": Disturbances(exposure_gain=0.2, exposure_flicker=0.02),
    "lens and compression": Disturbances(distortion=0.1, jpeg_quality=70),
}
COLUMNS = (
    Column("PSNR, dB", "psnr"),
    Column("moving", "psnr_moving"),
    Column("motion error, px", "motion_error_moving"),
    Column("still", "motion_error_still", 3),
    Column("IoU of the confidence", "confidence_iou"),
)


@dataclass(frozen=True, kw_only=True)
class Options(ClipOptions):
    """Clips, work and output."""

    model: Positional[Path]
    """Animated glTF file."""
    animation: str = "Walk"
    """Name of the animation."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits of each clip."""
    cameras: int = 7
    """Number of cameras, the held-out one included."""
    gaussians: int | None = 6000
    """Gaussians of the first frame."""
    steps: int | None = 800
    """Steps of the first frame."""

    def study(self) -> Study:
        """Return the study of the disturbances."""
        given = {"cameras": self.cameras, "animation": self.animation}
        clips = {
            n: self.clip(self.model, n.replace(" ", "-"), disturbances=d, **given) for n, d in DISTURBANCES.items()
        }
        scenes = [Scene({"disturbance": n}, (Source.of(clip), self.frames)) for n, clip in clips.items()]
        return Study(measure, scenes, [Variant({}, self.config())], self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return mean and standard deviation over the fits of each disturbance."""
        return scores_table(rows, {"disturbance": "disturbance"}, COLUMNS)


if __name__ == "__main__":
    tyro.cli(Options).run()

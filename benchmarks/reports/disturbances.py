"""Fits of an animated glTF model that is recorded with disturbances, against the exact ground truth.

    python -m benchmarks.reports.disturbances fox.glb --json out.json

Each cell is the same animation from the same cameras with one kind of disturbance. Scores are means over the later
frames of the held-out view, which is the reference: it has no time offset, and the right exposure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import mitsuba as mi
import tyro
from tyro.conf import Positional

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.plots import markdown
from benchmarks.reports.random_scenes import measure, spread
from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.synth.disturbances import Disturbances
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

__all__ = ["CELLS", "Options", "disturbance_table", "main"]

CELLS = {
    "none": Disturbances(),
    "time offset": Disturbances(time_offset=0.5),
    "rolling shutter": Disturbances(rolling_shutter=0.5),
    "exposure": Disturbances(exposure_gain=0.2, exposure_flicker=0.02),
    "lens and compression": Disturbances(distortion=0.1, jpeg_quality=70),
}
_COLUMNS = ("psnr", "psnr_moving", "motion_error_moving", "motion_error_still", "confidence_iou")
_DECIMALS = (2, 2, 2, 3, 2)


@dataclass(frozen=True, kw_only=True)
class Options(CellOptions):
    """Clips, work and output."""

    model: Positional[Path]
    """Animated glTF file."""
    animation: str = "Walk"
    """Name of the animation."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits of each clip."""
    clips: Path = Path("out/disturbances")
    """Folder of the clips, which are made if they are not there."""
    cameras: int = 7
    """Number of cameras, the held-out one included."""
    width: int = 160
    """Width of the images in pixels; the height is three quarters of it."""
    frames: int = 6
    """Number of frames."""
    num_gaussians: int = 6000
    """Gaussians of the first frame."""
    first_frame_steps: int = 800
    """Optimisation steps of the first frame."""
    epochs: int = 4
    """Epochs of a later frame."""

    def cells(self) -> dict[str, tuple[Source, StreamConfig, int]]:
        """Return clip, settings and number of frames of each cell, by disturbance and the fit's seed."""
        config = StreamConfig()
        work = {name: getattr(self, name) for name in ("num_gaussians", "first_frame_steps", "epochs")}
        config = replace(config, fit=replace(config.fit, **work))
        clips = {name: self.clip(name, own) for name, own in CELLS.items()}
        return {
            f"{name}/{seed}": (clip, replace(config, seed=seed), self.frames)
            for name, clip in clips.items()
            for seed in self.fit_seeds
        }

    def clip(self, name: str, disturbances: Disturbances) -> Source:
        """Return the clip of a cell."""
        folder = self.clips / name.replace(" ", "-")
        if not folder.exists():
            size = SynthConfig(self.cameras, self.frames, self.width, self.width * 3 // 4)
            synthesize(self.model, folder, replace(size, disturbances=disturbances, animation=self.animation))
        return Source.of(load_capture(folder))


def disturbance_table(cells: Mapping[str, Mapping[str, float]]) -> str:
    """Return mean and standard deviation over the fits of each disturbance as a table in Markdown."""
    rows = []
    for disturbance in dict.fromkeys(name.split("/")[0] for name in cells):
        found = spread({name: row for name, row in cells.items() if name.split("/")[0] == disturbance})
        scores = (found[column] for column in _COLUMNS)
        written = (f"{s['mean']:.{k}f} ± {s['deviation']:.{k}f}" for s, k in zip(scores, _DECIMALS, strict=True))
        rows.append((disturbance, *written))
    return markdown(("disturbance", "PSNR, dB", "moving", "motion error, px", "still", "IoU of the confidence"), rows)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    found = options.run(measure, options.cells())
    scores = {name: {column: row[column] for column in _COLUMNS} for name, row in found.items()}
    print(disturbance_table(scores))
    settings = {name: asdict(own) for name, own in CELLS.items()}
    options.write({"disturbances": settings, "cells": scores}, unprinted=["disturbances", "cells"])


if __name__ == "__main__":
    main(tyro.cli(Options))

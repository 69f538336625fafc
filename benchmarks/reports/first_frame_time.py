"""Held-out quality of the first frame over the time that it may take.

    python -m benchmarks.reports.first_frame_time --captures fern flower --seconds 60 120 300 --json out.json

A capture is a folder, or random-N: the first frame of `morgs-mi synth random --cameras 10 --noise 0` with the seed N.
Its own held-out view is compared, or camera 0.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.reports.fits import new_loop, synthetic
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import View, mean_psnr
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.tasks import Source
from morgs_mi.synth.synth_config import SynthConfig

COLUMNS = (
    Column("held-out view", "held_out", unit=" dB"),
    Column("training views", "training", unit=" dB"),
    Column("Gaussians", "gaussians", 0),
    Column("steps", "steps", 0),
    Column("processor time", "cpu_s", 0, unit=" s"),
)


@dataclass(frozen=True)
class Options(StudyOptions):
    """Captures, times and output."""

    captures: tuple[str, ...] = ("random-201", "random-202", "random-203")
    """Folders of captures, or random-N."""
    clips: Path = Path("out/first_frames")
    """Folder of the random clips, which are made where they are missing."""
    seconds: tuple[float, ...] = (60.0, 120.0, 300.0, 600.0)
    """Times of the first frame."""

    def study(self) -> Study:
        """Return the study of the captures by time."""
        scenes = [Scene({"capture": Path(name).name}, (Source.of(self._capture(name)),)) for name in self.captures]
        variants = [
            Variant({"seconds": seconds}, StreamConfig(FitConfig(first_frame_seconds=seconds)))
            for seconds in self.seconds
        ]
        return Study(measure, scenes, variants, self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the quality and the work of each capture and time."""
        return scores_table(rows, {name: name for name in ("capture", "seconds")}, COLUMNS)

    def _capture(self, name: str) -> Capture:
        if not name.startswith("random-"):
            return load_capture(name)
        return synthetic(
            "random", self.clips / name, SynthConfig(cameras=10, frames=1, noise=0.0, seed=int(name.split("-")[1]))
        )


def measure(source: Source, config: StreamConfig) -> dict[str, Any]:
    """Fit the first frame; return the PSNR of held-out and training views, and the announced and the actual work."""
    capture, stages = source.open(), []
    images, train = next(capture.frames(0, 1)).images, capture.train_views
    loop, start = new_loop(capture, config), time.process_time()
    _, report = loop.push([images[v] for v in train], lambda stage, *_: stages.append(stage))
    seconds = time.process_time() - start
    views = [View(*view) for view in zip(capture.cameras, images, capture.masks, strict=True)]
    held_out = [view for v, view in enumerate(views) if v not in train]
    assert loop.gaussians is not None
    return {
        "held_out": mean_psnr(loop.gaussians, held_out, config.render),
        "training": mean_psnr(loop.gaussians, [views[v] for v in train], config.render),
        "estimate": report.validation.get("expected_psnr"),
        "announced_s": float(found[1]) if (found := re.search(r"about (\d+) s", stages[-1])) else None,
        "gaussians": report.num_gaussians,
        "steps": report.steps,
        "cpu_s": seconds,
    }


if __name__ == "__main__":
    tyro.cli(Options).run()

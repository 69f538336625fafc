"""Drift: quality where things move, bytes and number of Gaussians from frame to frame, over many
frames.

    python -m benchmarks.reports.drift --json out.json

The clips are `morgs-mi synth arm` and random scenes that no setting was chosen on. Scores are of
the held-out view, against the exact ground truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from benchmarks.reports.fits import ClipOptions, new_loop
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.random_scenes import fitted_frames
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi.capture.capture import Capture
from morgs_mi.loop.stream_config import StreamConfig


def known(row: Row, score: str) -> np.ndarray:
    """Return the values of a score at the frames that have it."""
    values = np.array(row[score], float)
    return values[np.isfinite(values)]


COLUMNS = (
    Column("PSNR, dB", lambda row: known(row, "psnr").mean(), spread=False),
    Column("moving, dB", lambda row: known(row, "psnr_moving").mean(), spread=False),
    Column("slope, dB a frame", "slope_moving_db_a_frame", 3, spread=False),
)


@dataclass(frozen=True, kw_only=True)
class Options(ClipOptions):
    """Clips, work and output."""

    scenes: tuple[str, ...] = ("arm", "random-14", "random-15", "random-16")
    """Scenes; random-N is the random one of the seed N."""
    frames: int = 30
    """Number of frames."""
    width: int = 320
    """Width of the images in pixels; the height is three quarters of it."""
    gaussians: int | None = None
    """Gaussians of the first frame; default: by the detail of the images."""
    steps: int | None = None
    """Steps of the first frame; default: until it has converged."""
    epochs: int = 2
    """Epochs of a later frame."""

    def study(self) -> Study:
        """Return the study of the clips."""
        clips = {name: self.named_clip(name) for name in self.scenes}
        scenes = [Scene({"clip": name}, (clip, self.frames)) for name, clip in clips.items()]
        return Study(measure, scenes, [Variant({}, self.config())], self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the means over the fits of each clip."""
        return scores_table(rows, {"clip": lambda row: f"`{row['clip']}`"}, COLUMNS)


def measure(capture: Capture, num_frames: int, config: StreamConfig) -> dict[str, Any]:
    """Fit a clip and return its scores per later frame, and the slope of PSNR where things move, in
    dB a frame.
    """
    loop = new_loop(capture, config)
    frames = capture.partial_frames(0, num_frames)
    loop.push(next(frames).train)
    rows = list(fitted_frames(loop, capture, frames))
    series = {name: [row[name] for row in rows] for name in rows[0]}
    moving = np.array(series["psnr_moving"])
    mask = np.isfinite(moving)
    return {
        "slope_moving_db_a_frame": np.polyfit(np.flatnonzero(mask), moving[mask], 1)[0],
        **series,
    }


if __name__ == "__main__":
    tyro.cli(Options).run()

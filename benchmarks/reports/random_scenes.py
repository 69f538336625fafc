"""Later frames of scenes that no setting was chosen on: quality, confidence and bytes.

    python -m benchmarks.reports.random_scenes --seeds 3 4 5 6 7 8 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, made in `--clips` if it is not there. Settings
were chosen on seeds 0 to 2. Scores are means over the later frames of the held-out view, against
the exact ground truth.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.reports.fits import new_loop, random_capture
from benchmarks.reports.plots import Column, means_over, scores_table
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi import Gaussians, StreamLoop, rasterize
from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.capture.truth import load_truth
from morgs_mi.evaluate.metrics import iou, psnr
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig

COLUMNS = (
    Column("PSNR, dB", "psnr", spread=False),
    Column("moving, dB", "psnr_moving"),
    Column("IoU of the confidence", "confidence_iou", spread=False),
    Column("motion error, px", "motion_error_moving", spread=False),
)


@dataclass(frozen=True)
class Options(StudyOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 4, 5, 6, 7, 8)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    frames: int = 6
    """Number of frames that are fitted, the first included."""
    epochs: int = 2
    """Epochs of a later frame."""

    def study(self) -> Study:
        """Return the study of the clips."""
        captures = {seed: random_capture(self.clips, seed) for seed in self.seeds}
        scenes = [Scene({"seed": seed}, (clip, self.frames)) for seed, clip in captures.items()]
        return Study(
            measure,
            scenes,
            [Variant({}, StreamConfig(FitConfig(epochs=self.epochs)))],
            self.fit_seeds,
        )

    def table(self, rows: Sequence[Row]) -> str:
        """Return the scores of each scene and of their means."""
        return scores_table(
            [*rows, *means_over(rows, "fit_seed", seed="mean")], {"seed": "seed"}, COLUMNS
        )


def measure(capture: Capture, num_frames: int, config: StreamConfig) -> dict[str, float]:
    """Fit a clip and return the means of the scores of its later frames."""
    first, *later_frames = capture.partial_frames(0, num_frames)
    loop = new_loop(capture, config)
    loop.push(first.train)
    rows = list(fitted_frames(loop, capture, later_frames))
    return {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}


def fitted_frames(
    loop: StreamLoop, capture: Capture, frames: Iterable[PartialFrame]
) -> Iterator[dict[str, float]]:
    """Fit frames after the first one, and yield the scores of those that the held-out view has
    recorded.
    """
    test = capture.reference_view
    for frame in frames:
        start = time.process_time()
        _, report = loop.push(frame.train)
        seconds = time.process_time() - start
        image = frame.images[test]
        if image is not None and loop.gaussians is not None:
            scores = scores_of(loop.gaussians, capture, test, frame.index, image)
            sizes = {"bytes": report.num_bytes, "num_gaussians": report.num_gaussians}
            yield {**scores, **sizes, "cpu_s": seconds, **report.active}


def scores_of(
    gaussians: Gaussians, capture: Capture, view: int, frame: int, recorded: np.ndarray
) -> dict[str, float]:
    """Return the scores of a frame in one view."""
    assert capture.truth is not None
    camera = capture.cameras[view]
    truth = load_truth(capture.truth, camera.name, frame)
    image = rasterize(gaussians, camera, ("color", "motion", "confidence"))
    color = np.clip(np.asarray(image.color), 0, 1)
    confidence = np.asarray(image.confidence).reshape(truth.mask.shape)
    target = recorded / 255.0
    error = np.linalg.norm(np.asarray(image.motion) - truth.motion, axis=-1)
    return {
        "psnr": psnr(color, target),
        "psnr_moving": psnr(color[truth.mask], target[truth.mask]) if truth.mask.any() else np.nan,
        "confidence_iou": iou(confidence > 0.5, truth.mask),
        "motion_error_moving": float(error[truth.mask].mean()) if truth.mask.any() else np.nan,
    }


if __name__ == "__main__":
    tyro.cli(Options).run()

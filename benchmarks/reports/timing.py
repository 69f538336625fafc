"""Cameras that record at times of their own: how exactly offsets are found, and what rendering at
these times gains.

    python -m benchmarks.reports.timing --seeds 3 6 --json out.json

Each scene is `morgs-mi synth random --seed SEED`, recorded twice: by cameras of one clock, and by
cameras that are up to 1.5 frames apart. The second clip is fitted as it is and with the
offsets that are found, over the same timestamps as the first. Scores are means over the later
frames of the held-out view. Its clock is the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import tyro

from benchmarks.reports.fits import ClipOptions, new_loop
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.random_scenes import scores_of
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.evaluate.results import known_mean
from morgs_mi.extras.calibration.timing import estimate_time_offsets
from morgs_mi.extras.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.fit_capture import push_frame

_TIME_OFFSET = 1.5  # largest one, in frames
COLUMNS = (
    Column("mean error", "mean_error", 3, spread=False),
    Column("synchronised, dB", "synchronised_moving", spread=False),
    Column("apart", "recorded_moving", spread=False),
    Column("aligned", "aligned_moving", spread=False),
)


@dataclass(frozen=True, kw_only=True)
class Options(ClipOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 6)
    """Seeds of the scenes."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits of each scene."""
    frames: int = 12
    """Number of frames of a clip."""
    fitted: int = 4
    """Number of frames that are fitted, the first included."""
    steps: int | None = 500
    """Steps of the first frame."""

    def study(self) -> Study:
        """Return the study of the scenes, each recorded by both rigs; a cell has the rows of all
        seeds.
        """
        rigs = {"one-clock": Disturbances(), "apart": Disturbances(time_offset=_TIME_OFFSET)}
        scenes = []
        for seed in self.seeds:
            clips = tuple(
                self.clip("random", f"random-{seed}-{n}", disturbances=d, seed=seed)
                for n, d in rigs.items()
            )
            scenes.append(Scene({"scene": f"random {seed}"}, (*clips, self.fitted, self.fit_seeds)))
        return Study(measure, scenes, [Variant({}, self.config(dropout=0.0))])

    def table(self, rows: Sequence[Row]) -> str:
        """Return the errors of each scene's offsets, and PSNR where things move."""
        return scores_table(rows, {"scene": "scene"}, COLUMNS)


def measure(
    synchronised: Capture,
    recording: Capture,
    num_frames: int,
    seeds: Sequence[int],
    config: StreamConfig,
) -> list[dict[str, float]]:
    """Return the errors of a scene's offsets, and the scores of its fits by the way in which it is
    read, by seed.
    """
    errors, offsets, reference = offset_errors(recording)
    aligned_capture = load_capture(
        recording.path, reading=replace(recording.reading, offset=offsets)
    )
    # `moving_psnr` converts its frame numbers to the numbers of the ground truth.
    aligned_capture = replace(aligned_capture, truth=recording.truth)
    first = int(
        aligned_capture.metadata()["cameras"][recording.names.index(reference)]["first_frame"]
    )
    fits = {
        "synchronised": (synchronised, first),
        "recorded": (recording, first),
        "aligned": (aligned_capture, 0),
    }
    rows = []
    for seed in seeds:
        row = {"fit_seed": seed, **errors}
        seed_config = replace(config, seed=seed)
        for name, (capture, begin) in fits.items():
            frames = range(begin, begin + num_frames)
            row[f"{name}_moving"] = moving_psnr(capture, frames, first, seed_config)
        rows.append(row)
    return rows


def offset_errors(recorded: Capture) -> tuple[dict[str, float], dict[str, float], str]:
    """Return the errors of a clip's offsets, the offsets by camera, and the reference."""
    estimate = estimate_time_offsets(recorded)
    truth = load_disturbances(recorded.path / "truth")
    others = [name for name in estimate.offsets if name != estimate.reference]
    errors = np.abs([estimate.offsets[name] + truth[name].time_offset for name in others])
    figures = {
        "mean_error": errors.mean(),
        "standard_error": np.mean([estimate.errors[name] for name in others]),
    }
    return figures, dict(estimate.offsets), estimate.reference


def moving_psnr(capture: Capture, frames: range, first: int, config: StreamConfig) -> float:
    """Return the mean PSNR where things move of a fit of some timestamps, of which the first is
    frame `first` of the held-out clip.
    """
    test = capture.reference_view
    loop = new_loop(capture, config)
    scores = []
    for k, frame in enumerate(capture.partial_frames(frames.start, frames.stop)):
        push_frame(loop, frame)
        image = frame.images[test]
        assert loop.gaussians is not None
        assert image is not None
        if k:
            row = scores_of(loop.gaussians, capture, test, first + k, image)
            scores.append(row["psnr_moving"])
    return known_mean(scores)


if __name__ == "__main__":
    tyro.cli(Options).run()

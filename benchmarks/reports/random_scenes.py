"""Later frames of scenes that no setting was chosen on: quality, confidence and bytes.

    python -m benchmarks.reports.random_scenes --seeds 3 4 5 6 7 8 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, made in `--clips` if it is not there. Settings were chosen on seeds 0
to 2. Scores are means over the later frames of the held-out view, against the exact ground truth.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import new_loop, random_capture
from benchmarks.reports.plots import markdown
from morgs_mi import Gaussians, StreamLoop, rasterize
from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.evaluate.metrics import iou, psnr
from morgs_mi.synth.ground_truth import load_truth


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 4, 5, 6, 7, 8)
    """Seeds of the scenes."""
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each scene."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    frames: int = 6
    """Number of frames that are fitted, the first included."""
    epochs: int = 2
    """Epochs of a later frame."""

    def cells(self) -> dict[str, tuple[Source, StreamConfig, int]]:
        """Return clip, settings and number of frames of each scene and fit; clips that are missing are made."""
        config = StreamConfig()
        config = replace(config, fit=replace(config.fit, epochs=self.epochs))
        clips = {str(seed): Source.of(random_capture(self.clips, seed)) for seed in self.seeds}
        return {
            f"{seed}/{fit}": (clip, replace(config, seed=fit), self.frames)
            for (seed, clip), fit in product(clips.items(), self.fit_seeds)
        }


def measure(source: Source, config: StreamConfig, num_frames: int) -> dict[str, float]:
    """Fit a clip and return the means of the scores of its later frames."""
    capture = source.open()
    first, *later = capture.partial_frames(0, num_frames)
    loop = new_loop(capture, config)
    loop.push([first.images[v] for v in capture.train_views])
    return later_scores(loop, capture, later)


def later_scores(loop: StreamLoop, capture: Capture, frames: Iterable[PartialFrame]) -> dict[str, float]:
    """Fit frames after the first one and return the means of their scores."""
    rows = list(fitted_frames(loop, capture, frames))
    return {name: float(f"{np.nanmean([row[name] for row in rows]):.4g}") for name in rows[0]}


def fitted_frames(loop: StreamLoop, capture: Capture, frames: Iterable[PartialFrame]) -> Iterator[dict[str, float]]:
    """Fit frames after the first one, and yield the scores of those that the held-out view has recorded."""
    test = capture.test_view
    assert test is not None
    for frame in frames:
        start = time.process_time()
        _, report = loop.push([frame.images[v] for v in capture.train_views])
        seconds, recorded = time.process_time() - start, frame.images[test]
        if recorded is not None and loop.gaussians is not None:
            scores = scores_of(loop.gaussians, capture, test, frame.index, recorded)
            sizes = {"bytes": report.num_bytes, "num_gaussians": report.num_gaussians}
            yield {**scores, **sizes, "cpu_s": seconds, **report.active}


def scores_of(gaussians: Gaussians, capture: Capture, view: int, frame: int, recorded: np.ndarray) -> dict[str, float]:
    """Return the scores of a frame in one view."""
    assert capture.truth is not None
    camera = capture.cameras[view]
    truth = load_truth(capture.truth, camera.name, frame)
    image = rasterize(gaussians, camera, ("color", "motion", "confidence"))
    color, confidence = np.clip(np.asarray(image.color), 0, 1), np.asarray(image.confidence).reshape(truth.mask.shape)
    target, error = recorded / 255.0, np.linalg.norm(np.asarray(image.motion) - truth.motion, axis=-1)
    return {
        "psnr": psnr(color, target),
        "psnr_moving": psnr(color[truth.mask], target[truth.mask]) if truth.mask.any() else np.nan,
        "confidence_iou": iou(confidence > 0.5, truth.mask),
        "motion_error_moving": float(error[truth.mask].mean()) if truth.mask.any() else np.nan,
        "motion_error_still": float(error[~truth.mask].mean()),
    }


def spread(fits: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return mean and standard deviation over the fits, of the means over the scenes of each score."""
    numbers = sorted({name.split("/")[1] for name in fits})
    by_fit = [[row for name, row in fits.items() if name.split("/")[1] == number] for number in numbers]
    found = {}
    for score in next(iter(fits.values())):
        means = [float(np.nanmean([row[score] for row in rows])) for rows in by_fit]
        deviation = float(np.std(means, ddof=1)) if len(means) > 1 else 0.0
        found[score] = {"mean": float(f"{np.mean(means):.4g}"), "deviation": float(f"{deviation:.2g}")}
    return found


def scenes_table(fits: Mapping[str, Mapping[str, float]]) -> str:
    """Return mean and standard deviation over the fits of each scene, and of their means, as a table in Markdown."""
    columns = (("psnr", 2, 1), ("psnr_moving", 2, 1), ("confidence_iou", 3, 1), ("motion_error_moving", 2, 1))
    columns = (*columns, ("motion_error_still", 3, 1), ("bytes", 1, 1e-3))
    seeds = list(dict.fromkeys(name.split("/")[0] for name in fits))
    groups = {seed: {n: row for n, row in fits.items() if n.split("/")[0] == seed} for seed in seeds} | {"mean": fits}

    def cells(rows: Mapping[str, Mapping[str, float]]) -> list[str]:
        found = spread(rows)
        written = [(factor * found[s]["mean"], factor * found[s]["deviation"], k) for s, k, factor in columns]
        return [f"{mean:.{k}f} ± {deviation:.{k}f}" for mean, deviation, k in written]

    head = ("seed", "PSNR, dB", "moving", "IoU of the confidence", "motion error, px", "still", "kB")
    return markdown(head, [(name, *cells(rows)) for name, rows in groups.items()])


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    fits = options.run(measure, options.cells())
    print(scenes_table(fits))
    options.write({"spread": spread(fits), "fits": fits}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

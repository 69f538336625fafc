"""Later frames of scenes that no setting was chosen on: quality, confidence and bytes.

    python -m benchmarks.reports.random_scenes --seeds 3 4 5 6 7 8 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, made in `--clips` if it is not there. Settings were chosen on seeds 0
to 2. Scores are means over the later frames of the held-out view, against the exact ground truth.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from morgs_mi import Gaussians, StreamLoop, rasterize
from morgs_mi.capture.capture import Capture, PartialFrame, load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.evaluate.metrics import iou, psnr
from morgs_mi.synth.ground_truth import load_truth
from morgs_mi.synth.synthesize import synthesize


@dataclass(frozen=True)
class Options(Output):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 4, 5, 6, 7, 8)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    frames: int = 6
    """Number of frames that are fitted, the first included."""
    epochs: int = 2
    """Epochs of a later frame."""


def random_capture(clips: Path, seed: int, downscale: float = 1) -> Capture:
    """Return the random scene of a seed, which is made in the folder `clips` if it is not there."""
    clip = clips / f"random-{seed}"
    if not clip.exists():
        synthesize("random", clip, num_frames=8, seed=seed)
    return load_capture(clip, downscale)


def new_loop(capture: Capture, config: StreamConfig) -> StreamLoop:
    """Return the loop over a capture's training views."""
    train = capture.train_views
    masks = [capture.masks[v] for v in train]
    return StreamLoop([capture.cameras[v] for v in train], capture.points, capture.point_colors, config, masks)


def later_scores(loop: StreamLoop, capture: Capture, frames: Sequence[PartialFrame]) -> dict[str, float]:
    """Fit frames after the first one and return the means of their scores."""
    test, rows = capture.test_view, []
    assert test is not None
    for frame in frames:
        start = time.process_time()
        _, report = loop.push([frame.images[v] for v in capture.train_views])
        seconds, recorded = time.process_time() - start, frame.images[test]
        if recorded is not None and loop.gaussians is not None:
            scores = scores_of(loop.gaussians, capture, test, frame.index, recorded)
            rows.append({**scores, "bytes": report.num_bytes, "cpu_s": seconds, **report.active})
    return {name: float(f"{np.nanmean([row[name] for row in rows]):.4g}") for name in rows[0]}


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


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    config = replace(config, fit=replace(config.fit, epochs=options.epochs))
    rows: dict[str, Any] = {}
    for seed in options.seeds:
        capture = random_capture(options.clips, seed)
        first, *later = capture.partial_frames(0, options.frames)
        loop = new_loop(capture, config)
        loop.push([first.images[v] for v in capture.train_views])
        rows[str(seed)] = later_scores(loop, capture, later)
        print(f"seed {seed}", rows[str(seed)], flush=True)
    options.write({"seeds": rows}, unprinted=["seeds"])


if __name__ == "__main__":
    main(tyro.cli(Options))

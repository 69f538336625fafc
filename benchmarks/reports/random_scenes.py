"""Later frames of scenes that no setting was chosen on: quality, confidence and bytes.

    python -m benchmarks.reports.random_scenes --seeds 3 4 5 6 7 8 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, made in `--clips` if it is not there. Settings were chosen on seeds 0
to 2. Scores are means over the later frames of the held-out view, against the exact ground truth.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from morgs_mi import Gaussians, StreamLoop, rasterize
from morgs_mi.capture.capture import Capture, load_capture
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


def measure(capture: Capture, config: StreamConfig, num_frames: int) -> dict[str, float]:
    """Fit the frames of a capture and return the means over the later ones."""
    train, test = capture.train_views, capture.test_view
    assert test is not None
    masks = [capture.masks[v] for v in train]
    loop = StreamLoop([capture.cameras[v] for v in train], capture.points, capture.point_colors, config, masks)
    rows = []
    for frame in capture.partial_frames(0, num_frames):
        start = time.process_time()
        _, report = loop.push([frame.images[v] for v in train])
        seconds = time.process_time() - start
        recorded = frame.images[test]
        if frame.index == 0 or recorded is None:
            continue
        assert loop.gaussians is not None
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
        rows[str(seed)] = measure(random_capture(options.clips, seed), config, options.frames)
        print(f"seed {seed}", rows[str(seed)], flush=True)
    options.write({"seeds": rows}, unprinted=["seeds"])


if __name__ == "__main__":
    main(tyro.cli(Options))

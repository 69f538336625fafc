"""First frames with and without cross-validation: quality of the held-out view, and the estimate of it.

    python -m benchmarks.reports.generalise --seeds 3 4 5 6 7 8 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`. The first frame is fitted as by default, where
cross-validation chooses the probability of dropping, and without dropping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.random_scenes import random_capture
from benchmarks.speed.output import Output
from morgs_mi import StreamLoop, rasterize
from morgs_mi.capture.capture import Capture
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.stream_loop import FrameReport


@dataclass(frozen=True)
class Options(Output):
    """Clips and output."""

    seeds: tuple[int, ...] = (3, 4, 5, 6, 7, 8)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    steps: int = 1500
    """Steps of the first frame."""


def first_frame(capture: Capture, train: Sequence[int], config: StreamConfig) -> tuple[np.ndarray, FrameReport]:
    """Fit the first frame to the views `train`; return the PSNR of each view of the capture [C], and the report."""
    cameras, masks = [capture.cameras[v] for v in train], [capture.masks[v] for v in train]
    loop = StreamLoop(cameras, capture.points, capture.point_colors, config, masks)
    images = next(capture.frames(0, 1)).images
    _, report = loop.push([images[v] for v in train])
    gaussians = loop.gaussians
    assert gaussians is not None

    def score(camera: Camera, image: np.ndarray, mask: np.ndarray | None) -> float:
        found, valid = np.asarray(rasterize(gaussians, camera, ("color",)).color), slice(None) if mask is None else mask
        return psnr(np.clip(found, 0, 1)[valid], image[valid] / 255.0)

    return np.array([score(*view) for view in zip(capture.cameras, images, capture.masks, strict=True)]), report


def measure(capture: Capture, config: StreamConfig) -> dict[str, float]:
    """Fit the first frame; return PSNR of the held-out view and of the training views, seconds, and the estimate."""
    train, test = capture.train_views, capture.test_view
    assert test is not None
    scores, report = first_frame(capture, train, config)
    figures = {
        "held_out": float(scores[test]),
        "training": float(scores[list(train)].mean()),
        "seconds": report.seconds,
    }
    if "trials" not in report.validation:
        return figures
    best = max(report.validation["trials"], key=lambda trial: trial["withheld_psnr"])
    return {**figures, "dropping": best["dropping"], "estimate": best["withheld_psnr"]}


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    config = replace(config, fit=replace(config.fit, first_frame_steps=options.steps))
    rows: dict[str, Any] = {}
    for seed in options.seeds:
        capture = random_capture(options.clips, seed)
        without = replace(config, fit=replace(config.fit, dropping=0.0))
        rows[str(seed)] = {
            "views": len(capture.train_views),
            "without": measure(capture, without),
            "chosen": measure(capture, config),
        }
        print(f"seed {seed}", rows[str(seed)], flush=True)
    options.write({"steps": options.steps, "seeds": rows}, unprinted=["seeds"])


if __name__ == "__main__":
    main(tyro.cli(Options))

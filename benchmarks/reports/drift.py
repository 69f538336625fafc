"""Drift: quality where things move, bytes and number of Gaussians from frame to frame, over many frames.

    python -m benchmarks.reports.drift --json out.json

The clips are `morgs-mi synth arm` and random scenes that no setting was chosen on. Scores are those of the held-out
view against the exact ground truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.random_scenes import new_loop, scores_of
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.synth.synthesize import synthesize


@dataclass(frozen=True)
class Options(Output):
    """Clips, work and output."""

    scenes: tuple[str, ...] = ("arm", "random-14", "random-15", "random-16")
    """Scenes; random-N is the random one of the seed N."""
    clips: Path = Path("out/drift")
    """Folder of the clips, which are made where they are missing."""
    frames: int = 30
    """Number of frames."""
    epochs: int = 2
    """Epochs of a later frame."""


def measure(clip: Path, config: StreamConfig, num_frames: int) -> dict[str, Any]:
    """Fit a clip and return its scores per later frame, and the slope of PSNR where things move, in dB a frame."""
    capture = load_capture(clip)
    test, loop, rows = capture.test_view, new_loop(capture, config), []
    assert test is not None
    for frame in capture.partial_frames(0, num_frames):
        _, report = loop.push([frame.images[v] for v in capture.train_views])
        recorded = frame.images[test]
        assert loop.gaussians is not None
        assert recorded is not None
        scores = scores_of(loop.gaussians, capture, test, frame.index, recorded)
        rows.append({**scores, "bytes": report.num_bytes, "num_gaussians": report.num_gaussians})
        print(clip.name, frame.index, rows[-1], flush=True)
    series = {name: [float(f"{row[name]:.4g}") for row in rows[1:]] for name in rows[0]}
    moving = np.array(series["psnr_moving"])
    seen = np.isfinite(moving)
    slope = np.polyfit(np.flatnonzero(seen), moving[seen], 1)[0]
    return {"slope_moving_db_a_frame": float(f"{slope:.3g}"), **series}


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    config, rows = replace(config, fit=replace(config.fit, epochs=options.epochs)), {}
    for name in options.scenes:
        clip, (scene, _, seed) = options.clips / name, name.partition("-")
        if not clip.exists():
            synthesize(scene, clip, num_frames=options.frames, seed=int(seed or 0))
    for name in options.scenes:
        rows[name] = measure(options.clips / name, config, options.frames)
    options.write({"clips": rows}, unprinted=["clips"])


if __name__ == "__main__":
    main(tyro.cli(Options))

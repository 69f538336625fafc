"""Drift: quality where things move, bytes and number of Gaussians from frame to frame, over many frames.

    python -m benchmarks.reports.drift --json out.json

The clips are `morgs-mi synth arm` and random scenes that no setting was chosen on. Scores are those of the held-out
view against the exact ground truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import new_loop
from benchmarks.reports.plots import markdown, plus_minus
from benchmarks.reports.random_scenes import fitted_frames
from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips, work and output."""

    scenes: tuple[str, ...] = ("arm", "random-14", "random-15", "random-16")
    """Scenes; random-N is the random one of the seed N."""
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each clip."""
    clips: Path = Path("out/drift")
    """Folder of the clips, which are made where they are missing."""
    frames: int = 30
    """Number of frames."""
    epochs: int = 2
    """Epochs of a later frame."""


def measure(source: Source, config: StreamConfig, num_frames: int) -> dict[str, Any]:
    """Fit a clip and return its scores per later frame, and the slope of PSNR where things move, in dB a frame."""
    capture = source.open()
    loop, frames = new_loop(capture, config), capture.partial_frames(0, num_frames)
    images = next(frames).images
    loop.push([images[v] for v in capture.train_views])
    rows = list(fitted_frames(loop, capture, frames))
    series = {name: [float(f"{row[name]:.4g}") for row in rows] for name in rows[0]}
    moving = np.array(series["psnr_moving"])
    seen = np.isfinite(moving)
    slope = np.polyfit(np.flatnonzero(seen), moving[seen], 1)[0]
    return {"slope_moving_db_a_frame": float(f"{slope:.3g}"), **series}


def drift_table(fits: Mapping[str, Mapping[str, Any]]) -> str:
    """Return mean and standard deviation over the fits of each clip as a table in Markdown."""
    rows = []
    for name in dict.fromkeys(fit.split("/")[0] for fit in fits):
        own = [row for fit, row in fits.items() if fit.split("/")[0] == name]
        moving = [np.array(row["psnr_moving"]) for row in own]
        known = [values[np.isfinite(values)] for values in moving]
        values = (
            (2, [np.mean(row["psnr"]) for row in own]),
            (2, [v[0] for v in known]),
            (2, [v[-1] for v in known]),
            (2, [v.mean() for v in known]),
            (3, [row["slope_moving_db_a_frame"] for row in own]),
            (2, [np.nanmean(row["confidence_iou"]) for row in own]),
            (1, [np.mean(row["bytes"]) / 1000 for row in own]),
        )
        rows.append((name, *(plus_minus(v, k) for k, v in values)))
    head = ("clip", "PSNR, dB", "moving: first", "last", "mean", "slope, dB a frame", "IoU", "kB")
    return markdown(head, rows)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    config, cells = replace(config, fit=replace(config.fit, epochs=options.epochs)), {}
    for name in options.scenes:
        clip, (scene, _, seed) = options.clips / name, name.partition("-")
        if not clip.exists():
            synthesize(scene, clip, SynthConfig(frames=options.frames, seed=int(seed or 0)))
        source = Source.of(load_capture(clip))
        cells |= {f"{name}/{own}": (source, replace(config, seed=own), options.frames) for own in options.fit_seeds}
    found = options.run(measure, cells)
    print(drift_table(found))
    options.write({"clips": found}, unprinted=["clips"])


if __name__ == "__main__":
    main(tyro.cli(Options))

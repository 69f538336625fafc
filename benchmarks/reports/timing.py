"""Cameras that record at times of their own: how exactly offsets are found, and what rendering at these times gains.

    python -m benchmarks.reports.timing --seeds 3 6 --json out.json

Each scene is `morgs-mi synth random --seed SEED`, recorded three times: by cameras of one clock, by cameras that are up
to `--time-offset` frames apart, and by cameras with a rolling shutter. The second clip is fitted as it is and with the
offsets that are found, the third as if its shutter were global and with its readout, all over the same instants as the
first. Scores are means over the later frames of the held-out view, whose clock is the reference.
"""

from __future__ import annotations

import time
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
from morgs_mi import rasterize
from morgs_mi.calibration.timing import estimate_time_offsets
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.recorder import push_frame
from morgs_mi.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.synth.ground_truth import load_truth
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

__all__ = ["Options", "main", "timing_table"]


@dataclass(frozen=True, kw_only=True)
class Options(CellOptions):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (3, 6)
    """Seeds of the scenes."""
    clips: Path = Path("out/timing")
    """Folder of the clips, which are made if they are not there."""
    width: int = 160
    """Width of the images in pixels; the height is three quarters of it."""
    frames: int = 12
    """Number of frames of a clip."""
    fitted: int = 4
    """Number of frames that are fitted, the first included."""
    time_offset: float = 1.5
    """Largest time offset in frames."""
    readout: float = 0.6
    """Readout of the rolling shutters in frames."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits of each clip."""
    num_gaussians: int = 4000
    """Gaussians of the first frame."""
    first_frame_steps: int = 500
    """Optimisation steps of the first frame."""
    epochs: int = 4
    """Epochs of a later frame."""

    def cells(self) -> dict[str, tuple[Options, int]]:
        """Return the options and the seed of each scene."""
        return {f"random {seed}": (self, seed) for seed in self.seeds}

    def config(self, seed: int) -> StreamConfig:
        """Return the settings of a fit."""
        config = StreamConfig(seed=seed)
        work = {name: getattr(self, name) for name in ("num_gaussians", "first_frame_steps", "epochs")}
        return replace(config, fit=replace(config.fit, dropping=0.0, **work))

    def clip(self, seed: int, own: Disturbances) -> Path:
        """Return the folder of a clip, which is made if it is not there."""
        folder = self.clips / f"random-{seed}-{own.time_offset:g}-{own.rolling_shutter:g}"
        if not folder.exists():
            width, height = self.width, self.width * 3 // 4
            config = SynthConfig(frames=self.frames, width=width, height=height, disturbances=own, seed=seed)
            synthesize("random", folder, config)
        return folder


def measure(options: Options, seed: int) -> dict[str, Any]:
    """Return the errors of the offsets of one scene, and the scores of its fits by the way in which it is read."""
    apart, rolling = Disturbances(time_offset=options.time_offset), Disturbances(rolling_shutter=options.readout)
    recorded, start = load_capture(options.clip(seed, apart)), time.perf_counter()
    found = estimate_time_offsets(recorded)
    seconds = time.perf_counter() - start
    truth = load_disturbances(recorded.path / "truth")
    others = [name for name in found.offsets if name != found.reference]
    errors = [found.offsets[name] + truth[name].time_offset for name in others]
    aligned = load_capture(recorded.path, reading=replace(recorded.reading, offset=found.offsets))
    first = int(aligned.metadata()["cameras"][recorded.names.index(found.reference)]["first_frame"])
    synchronised, shutter = load_capture(options.clip(seed, Disturbances())), load_capture(options.clip(seed, rolling))
    cameras = tuple(replace(camera, readout=options.readout) for camera in shutter.cameras)
    fits = {
        "synchronised": (synchronised, first),
        "recorded": (recorded, first),
        "aligned": (aligned, 0),
        "shutter": (shutter, first),
        "readout": (replace(shutter, cameras=cameras), first),
    }
    numbers = {
        "views": len(recorded.cameras),
        "largest_offset": max(abs(camera.time_offset) for camera in truth.values()),
        "mean_error": float(np.abs(errors).mean()),
        "largest_error": float(np.abs(errors).max()),
        "standard_error": float(np.mean([found.errors[name] for name in others])),
        "seconds": seconds,
    }
    row: dict[str, Any] = {name: float(f"{value:.4g}") for name, value in numbers.items()}
    for name, (capture, begin) in fits.items():
        rows = [scores(capture, begin, first, options.config(own), options.fitted) for own in options.fit_seeds]
        row[name] = {score: [float(f"{each[score]:.4g}") for each in rows] for score in rows[0]}
    return row


def scores(capture: Capture, begin: int, first: int, config: StreamConfig, num_frames: int) -> dict[str, float]:
    """Return the scores of a fit from the instant `begin` of a capture, which is frame `first` of the held-out clip."""
    test, loop, rows = capture.test_view, new_loop(capture, config), []
    assert test is not None
    camera = capture.cameras[test]
    for k, frame in enumerate(capture.partial_frames(begin, begin + num_frames)):
        push_frame(loop, frame, capture.train_views)
        image = frame.images[test]
        assert loop.gaussians is not None
        assert image is not None
        color, target = np.asarray(rasterize(loop.gaussians, camera, ("color",)).color), image / 255.0
        moving = load_truth(capture.path / "truth", camera.name, first + k).mask
        if k and moving.any():
            color = np.clip(color, 0, 1)
            rows.append((psnr(color, target), psnr(color[moving], target[moving])))
    return dict(zip(("psnr", "moving"), np.mean(rows, axis=0).tolist(), strict=True))


def timing_table(scenes: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the results for the scenes as a table in Markdown: PSNR where things move as mean and spread over fits."""
    names = ("synchronised", "recorded", "aligned", "shutter", "readout")
    rows = [
        (
            *(name, f"{row['views']:.0f}", f"{row['largest_offset']:.2f}"),
            *(f"{row[error]:.3f}" for error in ("mean_error", "largest_error", "standard_error")),
            *(plus_minus(row[fit]["moving"]) for fit in names),
        )
        for name, row in scenes.items()
    ]
    head = ("scene", "views", "largest offset", "mean error", "largest error", "standard error")
    return markdown((*head, "synchronised", "apart", "aligned", "rolling shutter", "with its readout"), rows)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    found = options.run(measure, options.cells())
    print(timing_table(found))
    options.write({"scenes": found}, unprinted=["scenes"])


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Time offsets of cameras whose clocks are apart: how exactly they are found, and what aligning the clips gains.

    python -m benchmarks.reports.timing --seeds 3 6 --json out.json

Each scene is `morgs-mi synth random --seed SEED`, recorded twice: by cameras of one clock, and by cameras that are up
to `--time-offset` frames apart. The clip with offsets is fitted as it is and with the offsets that are found, over the
same instants as the synchronised one. Scores are means over the later frames of the held-out view, whose clock is the
reference.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import new_loop
from morgs_mi import rasterize
from morgs_mi.calibration.timing import estimate_time_offsets
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.synth.ground_truth import load_truth
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
    num_gaussians: int = 4000
    """Gaussians of the first frame."""
    first_frame_steps: int = 500
    """Optimisation steps of the first frame."""
    epochs: int = 4
    """Epochs of a later frame."""

    def cells(self) -> dict[str, tuple[Path, Path, StreamConfig, int]]:
        """Return the synchronised clip, the other one, the settings and the number of fitted frames of each seed."""
        config = StreamConfig()
        work = {name: getattr(self, name) for name in ("num_gaussians", "first_frame_steps", "epochs")}
        config = replace(config, fit=replace(config.fit, **work))
        return {
            f"random {s}": (self.clip(s, 0), self.clip(s, self.time_offset), config, self.fitted) for s in self.seeds
        }

    def clip(self, seed: int, time_offset: float) -> Path:
        """Return the folder of a clip."""
        folder, own = self.clips / f"random-{seed}-{time_offset:g}", Disturbances(time_offset=time_offset)
        if not folder.exists():
            width, height = self.width, self.width * 3 // 4
            synthesize(
                "random", folder, num_frames=self.frames, width=width, height=height, disturbances=own, seed=seed
            )
        return folder


def measure(synchronised: Path, apart: Path, config: StreamConfig, num_frames: int) -> dict[str, float]:
    """Return the error of the offsets of one scene and the scores of the three fits."""
    recorded, start = load_capture(apart), time.perf_counter()
    found = estimate_time_offsets(recorded)
    seconds = time.perf_counter() - start
    truth = load_disturbances(apart / "truth")
    errors = [offset + truth[name].time_offset for name, offset in found.offsets.items() if name != found.reference]
    aligned = load_capture(apart, reading=replace(recorded.reading, offset=found.offsets))
    first = int(aligned.metadata()["cameras"][recorded.names.index(found.reference)]["first_frame"])
    fits = {"synchronised": (load_capture(synchronised), first), "recorded": (recorded, first), "aligned": (aligned, 0)}
    row = {
        "views": len(recorded.cameras),
        "largest_offset": max(abs(camera.time_offset) for camera in truth.values()),
        "mean_error": float(np.abs(errors).mean()),
        "largest_error": float(np.abs(errors).max()),
        "seconds": seconds,
    }
    for name, (capture, begin) in fits.items():
        row |= {f"{score}_{name}": value for score, value in scores(capture, begin, first, config, num_frames).items()}
    return {name: float(f"{value:.4g}") for name, value in row.items()}


def scores(capture: Capture, begin: int, first: int, config: StreamConfig, num_frames: int) -> dict[str, float]:
    """Return the scores of a fit from the instant `begin` of a capture, which is frame `first` of the held-out clip."""
    test, loop, rows = capture.test_view, new_loop(capture, config), []
    assert test is not None
    camera = capture.cameras[test]
    for k, frame in enumerate(capture.frames(begin, begin + num_frames)):
        loop.push([frame.images[v] for v in capture.train_views])
        assert loop.gaussians is not None
        color, target = np.asarray(rasterize(loop.gaussians, camera, ("color",)).color), frame.images[test] / 255.0
        moving = load_truth(capture.path / "truth", camera.name, first + k).mask
        if k and moving.any():
            color = np.clip(color, 0, 1)
            rows.append((psnr(color, target), psnr(color[moving], target[moving])))
    return dict(zip(("psnr", "moving"), np.mean(rows, axis=0).tolist(), strict=True))


def timing_table(scenes: Mapping[str, Mapping[str, float]]) -> str:
    """Return the results of the scenes as a table in Markdown."""
    rows = [
        f"| {name} | {row['views']:.0f} | {row['largest_offset']:.2f} | {row['mean_error']:.3f} | "
        f"{row['largest_error']:.3f} | {row['moving_synchronised']:.2f} dB | {row['moving_recorded']:.2f} dB | "
        f"{row['moving_aligned']:.2f} dB |"
        for name, row in scenes.items()
    ]
    head = (
        "| scene | views | largest offset, frames | mean error | largest error | moving, synchronised | "
        "as recorded | aligned |"
    )
    return "\n".join([head, "|---|---|---|---|---|---|---|---|", *rows])


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    options.write({"scenes": options.run(measure, options.cells())}, unprinted=["scenes"])


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Live fits: quality where things move by the number of frames that are dropped between two that are fitted.

    python -m benchmarks.reports.live --json out.json

A live fit is that of a recording of the frames that it takes, so that frames of a clip are left out here in place of a
race with a clock. After the first frame, during whose fit many frames are dropped, the fit continues with the next
frame or after a gap. Scores are those of the held-out view, against the exact ground truth, at the instants that all
fits have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.fits import new_loop
from benchmarks.reports.random_scenes import fitted_frames
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.config import StreamConfig
from morgs_mi.synth.synthesize import synthesize


@dataclass(frozen=True)
class Options(Output):
    """Clips, work and output."""

    scenes: tuple[str, ...] = ("arm", "random-3")
    """Scenes; random-N is the random one of the seed N."""
    clips: Path = Path("out/live")
    """Folder of the clips, which are made where they are missing."""
    strides: tuple[int, ...] = (1, 2, 4, 8)
    """Frames from one that is fitted to the next, in ascending order."""
    gap: int = 16
    """Frames from the first one to the second, in a further fit of each stride; a multiple of the largest stride."""
    frames: int = 25
    """Frames of a clip."""
    width: int = 160
    """Width of the images; the height is three quarters of it."""
    epochs: int = 2
    """Epochs of a later frame."""
    gap_epochs: tuple[int, ...] = (10, 30)
    """Other numbers of epochs of the frame after the gap, each in a further fit of the smallest stride."""
    steps: int = 600
    """Steps of the first frame."""


def measure(capture: Capture, options: Options) -> dict[str, dict[str, list[float]]]:
    """Return PSNR where things move, dB, by stride and the second frame, at the common instants after the gap."""
    config = StreamConfig()
    config = replace(config, fit=replace(config.fit, epochs=options.epochs, first_frame_steps=options.steps))
    frames, loop = list(capture.partial_frames(0, options.frames)), new_loop(capture, config)
    loop.push([frames[0].images[v] for v in capture.train_views])
    first, largest = loop.state, options.strides[-1]
    scores: dict[str, dict[str, list[float]]] = {}
    for stride in options.strides:
        for name, second in (("continued", stride), ("after_gap", options.gap)):
            loop.state, taken = first, frames[second::stride]
            rows = zip(taken, fitted_frames(loop, capture, taken), strict=True)
            common = [row for frame, row in rows if frame.index >= options.gap and frame.index % largest == 0]
            scores.setdefault(f"{stride}", {})[name] = [round(row["psnr_moving"], 2) for row in common]
    setup, after, rest = (
        loop.setup,
        frames[options.gap : options.gap + 1],
        frames[options.gap + 1 :: options.strides[0]],
    )
    for epochs in options.gap_epochs:
        loop.state = first
        loop.setup = replace(setup, config=replace(config, fit=replace(config.fit, epochs=epochs)))
        rows = list(fitted_frames(loop, capture, after))
        loop.setup = setup
        rows += fitted_frames(loop, capture, rest)
        scores[f"{options.strides[0]}"][f"after_gap_{epochs}_epochs"] = [
            round(row["psnr_moving"], 2) for row in (rows[0], rows[-1])
        ]
    return scores


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    clips = {}
    for name in options.scenes:
        clip, (scene, _, seed) = options.clips / name, name.partition("-")
        if not clip.exists():
            height = 3 * options.width // 4
            synthesize(scene, clip, num_frames=options.frames, width=options.width, height=height, seed=int(seed or 0))
        scores = measure(load_capture(clip), options)
        clips[name] = {
            stride: {
                key: {"mean": round(float(np.nanmean(values)), 2), "psnr_moving": values} for key, values in row.items()
            }
            for stride, row in scores.items()
        }
    options.write({"clips": clips}, unprinted=["clips"])


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Live fits: quality where things move by the number of frames that are dropped between two that are fitted.

    python -m benchmarks.reports.live --fit-seeds 0 1 2 --json out.json

A live fit is that of a recording of the frames that it takes, so that frames of a clip are left out here in place of a
race with a clock. After the first frame, during whose fit many frames are dropped, the fit continues with the next
frame or after a gap. Scores are those of the held-out view, against the exact ground truth, at the instants that all
fits have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import new_loop
from benchmarks.reports.plots import grouped, markdown, plus_minus
from benchmarks.reports.random_scenes import fitted_frames
from morgs_mi.capture.capture import load_capture
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize


@dataclass(frozen=True)
class Options(CellOptions):
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
    fit_seeds: tuple[int, ...] = (0,)
    """Seeds of the fits of each clip."""


def measure(source: Source, options: Options, seed: int) -> list[dict[str, Any]]:
    """Return PSNR where things move, dB, at the common instants, by stride, second frame and its epochs."""
    config, capture = StreamConfig(seed=seed), source.open()
    config = replace(config, fit=replace(config.fit, epochs=options.epochs, first_frame_steps=options.steps))
    frames, loop = list(capture.partial_frames(0, options.frames)), new_loop(capture, config)
    loop.push([frames[0].images[v] for v in capture.train_views])
    first, setup, smallest, largest = loop.state, loop.setup, options.strides[0], options.strides[-1]
    cases = [(stride, second, options.epochs) for stride in options.strides for second in (stride, options.gap)]
    cases += [(smallest, options.gap, epochs) for epochs in options.gap_epochs]
    rows = []
    for stride, second, epochs in cases:
        loop.state = first
        own = setup.config
        loop.setup = replace(setup, config=replace(own, fit=replace(own.fit, epochs=epochs)))
        scores = list(fitted_frames(loop, capture, frames[second : second + 1]))
        loop.setup = setup
        scores += fitted_frames(loop, capture, frames[second + stride :: stride])
        taken = range(second, options.frames, stride)
        common = {t: row for t, row in zip(taken, scores, strict=True) if t >= options.gap and t % largest == 0}
        psnr = {str(t): round(row["psnr_moving"], 2) for t, row in common.items()}
        rows.append({"stride": stride, "second": second, "epochs": epochs, "psnr_moving": psnr})
    return rows


def strides_table(fits: Sequence[Mapping[str, Any]], gap: int) -> str:
    """Return the mean PSNR where things move by clip and stride, without a gap and after it, in Markdown."""
    fewest, rows = min(fit["epochs"] for fit in fits), []
    for (clip, stride), own in grouped((fit for fit in fits if fit["epochs"] == fewest), "clip", "stride").items():
        by_start = grouped(own, "second")
        psnrs = (
            [float(np.mean(list(fit["psnr_moving"].values()))) for fit in by_start[second,]] for second in (stride, gap)
        )
        rows.append((f"`{clip}`", f"{stride}", *(f"{plus_minus(values)} dB" for values in psnrs)))
    return markdown(("clip", "every n-th frame", "continued", "after a gap"), rows)


def epochs_table(fits: Sequence[Mapping[str, Any]], gap: int) -> str:
    """Return the PSNR where things move after a gap by clip and epochs of the frame after it, in Markdown."""
    smallest = min(fit["stride"] for fit in fits)
    after_gap = [fit for fit in fits if (fit["stride"], fit["second"]) == (smallest, gap)]
    instants = list(after_gap[0]["psnr_moving"])
    table = (
        (f"`{clip}`", f"{epochs}", *(f"{plus_minus([fit['psnr_moving'][t] for fit in own])} dB" for t in instants))
        for (clip, epochs), own in grouped(after_gap, "clip", "epochs").items()
    )
    return markdown(("clip", f"epochs of frame {gap}", *(f"frame {t}" for t in instants)), table)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    about, cells = {}, {}
    for name, seed in product(options.scenes, options.fit_seeds):
        clip, (scene, _, number) = options.clips / name, name.partition("-")
        if not clip.exists():
            height = 3 * options.width // 4
            config = SynthConfig(frames=options.frames, width=options.width, height=height, seed=int(number or 0))
            synthesize(scene, clip, config)
        cell = f"{name}, fit {seed}"
        cells[cell], about[cell] = (Source.of(load_capture(clip)), options, seed), {"clip": name, "seed": seed}
    rows = [{**about[cell], **row} for cell, found in options.run(measure, cells).items() for row in found]
    options.write({"gap": options.gap, "fits": rows}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Live fits: quality where things move by the number of frames that are dropped between two that are fitted.

    python -m benchmarks.reports.live --fit-seeds 0 1 2 --json out.json

A live fit equals the fit of a recording of the frames that it takes. Frames of a clip are left out here, in place of a
race with a clock. Many frames are dropped during the fit of the first one: the fit continues with the next frame or
after a gap. Scores are of the held-out view, against the exact ground truth, at the instants that all fits have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tyro

from benchmarks.reports.fits import ClipOptions, new_loop
from benchmarks.reports.plots import Column, grouped, scores_table
from benchmarks.reports.random_scenes import fitted_frames
from benchmarks.reports.study import Row, Scene, Study, Variant
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.tasks import Source


@dataclass(frozen=True, kw_only=True)
class Options(ClipOptions):
    """Clips, work and output."""

    scenes: tuple[str, ...] = ("arm", "random-3")
    """Scenes; random-N is the random one of the seed N."""
    strides: tuple[int, ...] = (1, 2, 4, 8)
    """Frames from one that is fitted to the next, in ascending order."""
    gap: int = 16
    """Frames from the first one to the second, in a further fit of each stride; a multiple of the largest stride."""
    gap_epochs: tuple[int, ...] = (10, 30)
    """Other numbers of epochs of the frame after the gap, each in a further fit of the smallest stride."""
    frames: int = 25
    """Number of frames."""
    gaussians: int | None = None
    """Gaussians of the first frame; default: by the detail of the images."""
    epochs: int = 2
    """Epochs of a later frame."""

    def study(self) -> Study:
        """Return the study of the clips; every cell has the rows of all strides."""
        starts = [(stride, second, self.epochs) for stride in self.strides for second in (stride, self.gap)]
        starts += [(self.strides[0], self.gap, epochs) for epochs in self.gap_epochs]
        common = [t for t in range(self.gap, self.frames) if t % self.strides[-1] == 0]
        clips = {name: Source.of(self.named_clip(name)) for name in self.scenes}
        scenes = [Scene({"clip": name}, (source, tuple(starts), common)) for name, source in clips.items()]
        return Study(measure, scenes, [Variant({}, self.config())], self.fit_seeds, seed_key="seed")

    def table(self, rows: Sequence[Row]) -> str:
        """Return both tables."""
        return f"{strides_table(rows)}\n{epochs_table(rows)}"


def measure(
    source: Source, starts: Sequence[tuple[int, int, int]], common: Sequence[int], config: StreamConfig
) -> list[dict[str, Any]]:
    """Return PSNR where things move, dB, at the common instants, by stride, second frame and its epochs."""
    capture = source.open()
    frames, loop = list(capture.partial_frames()), new_loop(capture, config)
    loop.push([frames[0].images[v] for v in capture.train_views])
    first, setup, rows = loop.state, loop.setup, []
    for stride, second, epochs in starts:
        loop.state = first
        loop.setup = replace(setup, config=replace(config, fit=replace(config.fit, epochs=epochs)))
        scores = list(fitted_frames(loop, capture, frames[second : second + 1]))
        loop.setup = setup
        scores += fitted_frames(loop, capture, frames[second + stride :: stride])
        by_frame = dict(zip(range(second, len(frames), stride), scores, strict=True))
        psnr = {str(t): by_frame[t]["psnr_moving"] for t in common}
        rows.append({"stride": stride, "second": second, "epochs": epochs, "psnr_moving": psnr})
    return rows


def strides_table(fits: Sequence[Row]) -> str:
    """Return the mean PSNR where things move by clip and stride, without a gap and after it, in Markdown."""
    fewest, rows = min(fit["epochs"] for fit in fits), []
    for own in grouped((fit for fit in fits if fit["epochs"] == fewest), "clip", "stride", "seed").values():
        continued, after_gap = (np.mean(list(fit["psnr_moving"].values())) for fit in own)
        rows.append({**own[0], "continued": continued, "after_gap": after_gap})
    columns = Column("continued", "continued", unit=" dB"), Column("after a gap", "after_gap", unit=" dB")
    return scores_table(rows, {"clip": lambda fit: f"`{fit['clip']}`", "every n-th frame": "stride"}, columns)


def epochs_table(fits: Sequence[Row]) -> str:
    """Return the PSNR where things move after a gap by clip and epochs of the frame after it, in Markdown."""
    smallest, gap = min(fit["stride"] for fit in fits), max(fit["second"] for fit in fits)
    after_gap = [fit for fit in fits if (fit["stride"], fit["second"]) == (smallest, gap)]

    def column(t: str) -> Column:
        return Column(f"frame {t}", lambda fit: fit["psnr_moving"][t], unit=" dB")

    keys = {"clip": lambda fit: f"`{fit['clip']}`", f"epochs of frame {gap}": "epochs"}
    return scores_table(after_gap, keys, [column(t) for t in after_gap[0]["psnr_moving"]])


if __name__ == "__main__":
    tyro.cli(Options).run()

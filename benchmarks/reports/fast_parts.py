"""Parts that move far from frame to frame: scores with and without the coarse search.

    python -m benchmarks.reports.fast_parts --fit-seeds 0 1 2 --json out.json

The clips are those of `random_scenes`. With a stride of 2, every second frame is left out, so that everything moves
twice as far. All fits of a clip continue from one first frame. Scores are means over the later frames of the held-out
view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import tyro

from benchmarks.reports import random_scenes
from benchmarks.reports.fits import new_loop
from benchmarks.reports.plots import markdown
from benchmarks.reports.random_scenes import later_scores, spread
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig


@dataclass(frozen=True)
class Options(random_scenes.Options):
    """Clips, work and output."""

    strides: tuple[int, ...] = (1, 2)
    """Frames from one that is fitted to the next."""


def measure(
    source: Source, config: StreamConfig, num_frames: int, strides: Sequence[int]
) -> dict[str, dict[str, dict[str, float]]]:
    """Fit a clip and return the means of the scores of its later frames, by stride, without and with the search."""
    capture, rows = source.open(), {}
    frames = list(capture.partial_frames(0, num_frames))
    before = [frames[0].images[v] for v in capture.train_views]
    first = new_loop(capture, config)
    first.push(before)
    assert first.state.coded is not None
    for stride in strides:
        for name, searches in (("without", False), ("search", True)):
            loop = new_loop(capture, replace(config, motion=replace(config.motion, search_motion=searches)))
            loop.resume(first.state.coded, [before])
            scores = later_scores(loop, capture, frames[stride::stride])
            rows.setdefault(f"stride_{stride}", {})[name] = scores
    return rows


def search_table(fits: Mapping[str, Mapping[str, Mapping[str, Mapping[str, float]]]]) -> str:
    """Return PSNR, and PSNR where things move, of each scene by stride, without and with the search, in Markdown."""
    seeds = dict.fromkeys(name.split("/")[0] for name in fits)
    groups = {seed: {name: fit for name, fit in fits.items() if name.split("/")[0] == seed} for seed in seeds}
    cases = [(stride, how) for stride, found in next(iter(fits.values())).items() for how in found]
    rows = []
    for name, own in (groups | {"mean": fits}).items():
        cells = []
        for stride, how in cases:
            found = spread({key: fit[stride][how] for key, fit in own.items()})
            scores = (found[score] for score in ("psnr", "psnr_moving"))
            cells.append(", ".join(f"{each['mean']:.2f} ± {each['deviation']:.2f}" for each in scores))
        rows.append((name, *cells))
    titles = (f"{stride.replace('_', ' ')}, {how}" for stride, how in cases)
    return markdown(("seed", *titles), rows)


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    cells = {name: (*cell, options.strides) for name, cell in options.cells().items()}
    fits = options.run(measure, cells)
    print(search_table(fits))
    options.write({"fits": fits}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Priors of later frames: held-out quality with each of those of `priors` that apply, and without.

    python -m benchmarks.reports.later_priors --seeds 16 17 18 --json out.json

The clips are those of `random_scenes`, where things appear from behind others. All fits of a clip and seed continue
from one first frame. The priors are patched into the fit here and act on the active Gaussians, births included. Scores
are means over the later frames of the held-out view.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any
from unittest.mock import patch

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports import random_scenes
from benchmarks.reports.fits import new_loop
from benchmarks.reports.priors import needles, size_and_opacity
from benchmarks.reports.random_scenes import later_scores
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Tensor
from morgs_mi.fit import later_frame as later
from morgs_mi.fit.dropping import dropped


@dataclass(frozen=True)
class Options(random_scenes.Options):
    """Clips, work and output."""

    seeds: tuple[int, ...] = (16, 17, 18)
    """Seeds of the scenes."""
    priors: tuple[str, ...] = ("none", "dropping", "penalties", "needles")
    """Priors that are compared."""
    first_frame_steps: int = 800
    """Steps of the first frame."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits."""


def measure(source: Source, config: StreamConfig, num_frames: int, priors: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Fit a clip and return the means of the scores of its later frames, by prior."""
    capture, rows = source.open(), {}
    frames = list(capture.partial_frames(0, num_frames))
    before = [frames[0].images[v] for v in capture.train_views]
    first = new_loop(capture, config)
    first.push(before)
    assert first.state.coded is not None
    for prior in priors:
        loop = new_loop(capture, config)
        loop.resume(first.state.coded, [before])
        with _PATCHES[prior](config.seed):
            rows[prior] = later_scores(loop, capture, frames[1:])
    return rows


@contextmanager
def _patched(
    change: Callable[[Gaussians], Gaussians], penalty: Callable[[Gaussians], Tensor] | None = None
) -> Iterator[None]:
    """Change the Gaussians that each step renders, and add a penalty of them to L_recon."""
    losses_at, apply = later._losses_at, later.apply_residual
    drawn: list[Gaussians] = []

    def noted(*args: Any) -> Gaussians:
        drawn[:] = [apply(*args)]
        return change(drawn[0])

    def penalised(*args: Any) -> dict[str, Tensor]:
        with patch.object(later, "apply_residual", noted):
            losses = losses_at(*args)
        return losses if penalty is None else losses | {"recon": losses["recon"] + penalty(drawn[0])}

    with patch.object(later, "_losses_at", penalised):
        yield


def _unchanged(gaussians: Gaussians) -> Gaussians:
    return gaussians


_PATCHES = {
    "none": lambda _: _patched(_unchanged),
    "dropping": lambda seed: _patched(partial(dropped, probability=0.1, rng=np.random.default_rng(seed))),
    "penalties": lambda _: _patched(_unchanged, size_and_opacity),
    "needles": lambda _: _patched(_unchanged, needles),
}


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    cells = {}
    for (name, (source, config, frames)), seed in product(options.cells().items(), options.fit_seeds):
        fit = replace(config.fit, first_frame_steps=options.first_frame_steps)
        cells[f"{name}; {seed}"] = source, replace(config, fit=fit, seed=seed), frames, options.priors
    options.write({"fits": options.run(measure, cells)}, unprinted=["fits"])


if __name__ == "__main__":
    main(tyro.cli(Options))

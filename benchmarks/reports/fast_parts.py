"""Parts that move far from frame to frame: scores with and without the coarse search.

    python -m benchmarks.reports.fast_parts --seeds 3 4 5 6 7 8 --json out.json

The clips are those of `random_scenes`. With a stride of 2, every second frame is left out, so that everything moves
twice as far. All fits of a clip continue from one first frame. Scores are means over the later frames of the held-out
view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import tyro

from benchmarks.reports import random_scenes
from benchmarks.reports.random_scenes import later_scores, new_loop, random_capture
from morgs_mi.config import StreamConfig


@dataclass(frozen=True)
class Options(random_scenes.Options):
    """Clips, work and output."""

    strides: tuple[int, ...] = (1, 2)
    """Frames from one that is fitted to the next."""


def main(options: Options) -> None:
    """Run the report."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    config = replace(config, fit=replace(config.fit, epochs=options.epochs))
    rows: dict[str, Any] = {}
    for seed in options.seeds:
        capture = random_capture(options.clips, seed)
        frames = list(capture.partial_frames(0, options.frames))
        before = [frames[0].images[v] for v in capture.train_views]
        first = new_loop(capture, config)
        first.push(before)
        assert first.state.coded is not None
        for stride in options.strides:
            for name, searches in (("without", False), ("search", True)):
                motion = replace(config.motion, search_motion=searches)
                loop = new_loop(capture, replace(config, motion=motion))
                loop.resume(first.state.coded, [before])
                scores = later_scores(loop, capture, frames[stride::stride])
                rows.setdefault(str(seed), {}).setdefault(f"stride_{stride}", {})[name] = scores
        print(f"seed {seed}", rows[str(seed)], flush=True)
    options.write({"seeds": rows}, unprinted=["seeds"])


if __name__ == "__main__":
    main(tyro.cli(Options))

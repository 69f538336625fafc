"""`morgs-mi salvage`: the intact frames of a damaged stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from morgs_mi.capture.outputs import check_output
from morgs_mi.cli.console import print_result

__all__ = ["Salvage"]


@dataclass(frozen=True)
class Salvage:
    """Write the playable frames of a damaged stream as a new one, and list the damaged bytes."""

    stream: Positional[Path]
    """Stream file, or the folder of a fit."""
    out: Positional[Path]
    """New stream file."""

    def run(self) -> None:
        from morgs_mi.codec.salvage import write_salvaged
        from morgs_mi.playback.streams import open_stream

        stream = open_stream(self.stream)
        frames, damaged = write_salvaged(stream, check_output(self.out))
        for span in damaged:
            print_result(f"{stream.path}: bytes {span.start} to {span.stop}: {span.problem.rstrip('.')}.")
        print_result(f"{self.out}: {len(frames)} frames, {_in_words(_runs(frames))}.")
        lost = _missing(sorted(frames), stream.metadata.get("num_frames"))
        if lost:
            count = sum(run.stop - run.start for run in lost)
            print_result(
                f"{count} frames cannot be played, {_in_words(lost)}: their packets are damaged, missing, or continue "
                "one that is; a stream plays on from the next intact keyframe."
            )


def _runs(numbers: Sequence[int]) -> list[range]:
    """Return ascending numbers as runs of consecutive ones."""
    runs = [[n for _, n in run] for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    return [range(run[0], run[-1] + 1) for run in runs]


def _missing(frames: Sequence[int], total: Any) -> list[range]:
    """Return the runs missing between ascending frames; those at the end only if `total` is a number of frames."""
    end = total if isinstance(total, int) else 0  # metadata is not checked: any type, any size
    return [range(a + 1, b) for a, b in pairwise([-1, *frames, end]) if b - a > 1]


def _in_words(runs: Sequence[range]) -> str:
    """Return runs as text, e.g. ``0 to 3, 7``."""
    return ", ".join(f"{run[0]} to {run[-1]}" if run[-1] > run[0] else f"{run[0]}" for run in runs)

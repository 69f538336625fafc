"""Measure the memory that small streams of very many Gaussians take.

    python -m benchmarks.speed.forged_memory --json out.json

Each stream is a keyframe of equal Gaussians, which an entropy code stores in almost no bytes, with as few words of code
as a decoder accepts. It is played in a process of its own. Memory is the largest resident set beyond that for a stream
of one Gaussian, in MB.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from morgs_mi import Gaussians
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import CodedFrame, coded_frames, reemitted_keyframe
from morgs_mi.codec.quantisation import Grid
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera


@dataclass(frozen=True)
class Options(Output):
    """Measure the memory of forged streams."""

    streams: tuple[tuple[int, int], ...] = ((62_600, 3), (135_000, 1), (190_000, 0), (200_000, 3), (700_000, 3))
    """Number of Gaussians and degree of each stream; the first three have the most integers that are
    accepted with few words."""


def write_forged(path: Path, count: int, degree: int) -> None:
    """Write a stream of equal Gaussians."""
    integers = 10 + 3 * (degree + 1) ** 2
    grid = Grid(
        np.zeros((count, integers), np.int32), np.zeros((count, 8), np.int8), np.zeros(count, np.uint8), degree, 0
    )
    one = Gaussians.from_activated([[0, 0, 0]], [[1, 1, 1]], [[1, 0, 0, 0]], [0.5], np.zeros((1, 1, 3)))
    state = CodedFrame(0, grid, np.arange(count, dtype=np.uint32), count, one)
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 60, 64, 48, "cam00")
    with path.open("wb") as file, StreamWriter(file, [camera], 25, {"num_frames": 1}) as writer:
        writer.write(reemitted_keyframe(state))


def play(path: str) -> None:
    """Play a stream, and print the largest resident set of this process in MB."""
    mi.set_variant("llvm_ad_rgb")
    assert sum(1 for _ in coded_frames(StreamReader(Path(path)))) == 1
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6)


def memory(path: Path) -> float:
    """Return the largest resident set of a process that plays a stream, MB."""
    code = "import sys; from benchmarks.speed.forged_memory import play; play(sys.argv[1])"
    arguments = [sys.executable, "-c", code, str(path)]
    return float(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)


def measure(options: Options) -> list[dict[str, Any]]:
    """Return size and memory of each stream."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stream.morgs"
        write_forged(path, 1, 0)
        before = memory(path)
        for count, degree in options.streams:
            write_forged(path, count, degree)
            size = path.stat().st_size / 1e6
            figures = {"file_mb": size, "play_mb": memory(path) - before, "aim_mb": 10 * size + 200}
            rows.append({"gaussians": count, "degree": degree, **figures})
    return rows


def main() -> None:
    """Run the command line."""
    mi.set_variant("llvm_ad_rgb")
    options = tyro.cli(Options)
    settings = {"streams": asdict(options)["streams"]}
    options.write({"settings": settings, "rows": measure(options)})


if __name__ == "__main__":
    main()

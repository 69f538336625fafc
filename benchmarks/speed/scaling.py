"""Measure fits in segments over the number of workers.

    python -m benchmarks.speed.scaling --json benchmarks/results/scaling.json

A synthetic clip is fitted in segments with one and with two workers of one thread each. The
efficiency is the throughput of W workers over W times the throughput of one: of the later frames,
which all workers fit side by side, and of the whole fit.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.codec.reader import StreamReader
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.seams import COMMON_FRAMES, SegmentConfig
from morgs_mi.runs.cluster.segments import SegmentedRun
from morgs_mi.runs.cluster.workers import open_client
from morgs_mi.studio.synth.synth_config import SynthConfig
from morgs_mi.studio.synth.synthesize import synthesize


@dataclass(frozen=True)
class Options(Output):
    """Clip and workers."""

    scene: str = "spheres"
    """Scene of the clip."""
    cameras: int = 7
    """Cameras of the clip, one of them held out."""
    frames: int = 64
    """Frames of the clip."""
    width: int = 320
    """Width of its images, px; the height is three quarters of it."""
    gaussians: int = 10_000
    """Gaussians of the first frame."""
    first_frame_steps: int = 600
    """Steps of the first frame."""
    epochs: int = 3
    """Epochs of a later frame."""
    segments: int = 4
    """Segments of the fits."""
    workers: tuple[int, ...] = (1, 2)
    """Numbers of workers, each with one thread on a core of its own."""


@dataclass(frozen=True)
class Run:
    """A measured fit.

    Attributes:
        workers: number of workers.
        seconds: wall time.
        start: seconds until the first worker answers.
        common: seconds of the common model.
        seam: mean seconds of a segment's first frame.
        later: mean seconds of a later frame.
        num_bytes: mean size of a later frame.
    """

    workers: int
    seconds: float
    start: float
    common: float
    seam: float
    later: float
    num_bytes: float


def measure(capture: Capture, options: Options, folder: Path) -> list[Run]:
    """Return the measured fits."""
    runs = []
    for count in options.workers:
        out = folder / f"{count}"
        begin = time.perf_counter()
        with _limited_to(count), open_client(count=count) as client:
            client.submit(os.getpid, pure=False).result()
            start = time.perf_counter() - begin
            begin = time.perf_counter()
            reports = SegmentedRun(
                capture, out, client, _config(options), SegmentConfig(options.segments)
            ).fit()
            runs.append(
                _run(count, start, time.perf_counter() - begin, reports, out / "stream.morgs")
            )
    return runs


@contextmanager
def _limited_to(count: int) -> Iterator[None]:
    """Limit this process, and those that it starts, to so many cores."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def _config(options: Options) -> StreamConfig:
    steps = options.first_frame_steps
    count = options.gaussians
    fit = FitConfig(
        num_gaussians=count, first_frame_steps=steps, epochs=options.epochs, dropping=0.0
    )
    return StreamConfig(fit=fit)


def _run(
    workers: int, start: float, seconds: float, reports: Sequence[FrameReport], stream: Path
) -> Run:
    starts = StreamReader(stream).metadata["segments"]["starts"]
    common = reports[:COMMON_FRAMES]
    frames = reports[COMMON_FRAMES:]
    seams = [report.seconds for report in frames if report.frame in starts]
    others = [report for report in frames if report.frame not in starts]
    return Run(
        workers,
        seconds,
        start,
        sum(report.seconds for report in common),
        float(np.mean(seams)),
        float(np.mean([report.seconds for report in others])),
        float(np.mean([report.num_bytes for report in others])),
    )


def efficiencies(runs: list[Run]) -> list[dict[str, float]]:
    """Return the efficiency of each number of workers: of later frames, and of the whole fit."""
    (one,) = (run for run in runs if run.workers == 1)
    return [
        {
            "workers": run.workers,
            "frames": one.later / run.later,
            "whole": one.seconds / (run.workers * run.seconds),
        }
        for run in runs
    ]


def main(options: Options) -> None:
    """Measure and write the figures."""
    mi.set_variant("llvm_ad_rgb")
    with TemporaryDirectory() as name:
        folder = Path(name)
        size = SynthConfig(options.cameras, options.frames, options.width, options.width * 3 // 4)
        synthesize(options.scene, folder / "clip", size)
        runs = measure(load_capture(folder / "clip"), options, folder)
    settings = asdict(replace(options, json=None))
    options.write(
        {
            "options": settings,
            "runs": [asdict(run) for run in runs],
            "efficiency": efficiencies(runs),
        }
    )


if __name__ == "__main__":
    main(tyro.cli(Options))

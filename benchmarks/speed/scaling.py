"""Measure fits in segments over the number of workers, and model larger clusters.

    python -m benchmarks.speed.scaling --json benchmarks/results/scaling.json --plot benchmarks/results/scaling.png

A synthetic clip is fitted in segments with one and with two workers of one thread each. The efficiency is the
throughput of W workers over W times the throughput of one: of the later frames, which all workers fit side by side,
and of the whole fit.

The model predicts the wall time of a long recording from the measured times of one worker. Its stages follow one
another:

    start     processes start and import the package
    first     common model: two frames on one worker
    seam      first frames of the segments, one per worker
    reading   each worker reads the frames of its segment
    frames    later frames of a segment, with the measured efficiency
    tasks     round trips of a segment's tasks
    client    packets through the client's link, their files and the join, one after the other

Times that depend on the images are scaled with the number of cameras. The bottleneck is the longest of the stages that
more workers do not shorten.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.plots import blank_figure, save_figure
from benchmarks.speed.output import Output
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.reader import StreamReader
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.cluster.seams import COMMON_FRAMES, SegmentConfig
from morgs_mi.runs.cluster.segments import TASK_FRAMES, SegmentedRun
from morgs_mi.runs.cluster.workers import open_client
from morgs_mi.stream_loop import FrameReport
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

if TYPE_CHECKING:
    from distributed import Client

_SHORTENED = {"reading", "frames", "tasks"}


@dataclass(frozen=True)
class Options(Output):
    """Clip, workers and the modelled cluster."""

    plot: Path | None = None
    """Plot, .png or .svg; needs matplotlib."""
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
    modelled: tuple[int, ...] = (8, 64, 512)
    """Numbers of workers of the model."""
    long_frames: int = 108_000
    """Frames of the modelled recording; the default is an hour at 30 per second."""
    long_cameras: int = 20
    """Cameras of the modelled recording."""
    link: float = 125e6
    """Bytes per second of the client's link; the default is a gigabit per second."""


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


@dataclass(frozen=True)
class Costs:
    """Measured costs of the client and of the recording, in seconds.

    Attributes:
        trip: of a task without work.
        read: of a frame's images.
        client: of a frame's packet, written and joined.
    """

    trip: float
    read: float
    client: float


def measure(capture: Capture, options: Options, folder: Path) -> tuple[list[Run], Costs]:
    """Return the measured fits, and the costs beside them."""
    runs, costs = [], None
    for count in options.workers:
        out, begin = folder / f"{count}", time.perf_counter()
        with _limited_to(count), open_client(count=count) as client:
            client.submit(os.getpid, pure=False).result()
            start = time.perf_counter() - begin
            begin = time.perf_counter()
            reports = SegmentedRun(capture, out, client, _config(options), SegmentConfig(options.segments)).fit()
            runs.append(_run(count, start, time.perf_counter() - begin, reports, out / "stream.morgs"))
            costs = costs or _costs(capture, client, out / "stream.morgs")
    assert costs is not None
    return runs, costs


@contextmanager
def _limited_to(count: int) -> Iterator[None]:
    """Limit this process, and those that it starts, to so many cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _config(options: Options) -> StreamConfig:
    steps, count = options.first_frame_steps, options.gaussians
    fit = FitConfig(num_gaussians=count, first_frame_steps=steps, epochs=options.epochs, dropping=0.0)
    return StreamConfig(fit=fit)


def _run(workers: int, start: float, seconds: float, reports: Sequence[FrameReport], stream: Path) -> Run:
    starts = StreamReader(stream).metadata["segments"]["starts"]
    common, others = reports[:COMMON_FRAMES], reports[COMMON_FRAMES:]
    seams = [report.seconds for report in others if report.frame in starts]
    later = [report for report in others if report.frame not in starts]
    return Run(
        workers,
        seconds,
        start,
        sum(report.seconds for report in common),
        float(np.mean(seams)),
        float(np.mean([report.seconds for report in later])),
        float(np.mean([report.num_bytes for report in later])),
    )


def _costs(capture: Capture, client: Client, stream: Path) -> Costs:
    def seconds_of(work: Any) -> float:
        begin = time.perf_counter()
        work()
        return time.perf_counter() - begin

    def write() -> None:
        reader = StreamReader(stream)
        with StreamWriter(stream.with_name("again.morgs"), reader.cameras, reader.fps) as writer:
            for packet in reader:
                writer.write(packet)

    frames = capture.num_frames
    return Costs(
        trip=float(np.median([seconds_of(lambda: client.submit(os.getpid, pure=False).result()) for _ in range(9)])),
        read=seconds_of(lambda: list(capture.partial_frames())) / frames,
        client=2 * seconds_of(write) / frames,  # into the segment, and into the joined stream
    )


def stages(workers: int, run: Run, costs: Costs, efficiency: float, views: float, options: Options) -> dict[str, float]:
    """Return the seconds of the stages of a long recording with one segment per worker, see the module.

    Args:
        workers: number of workers.
        run: of one worker.
        costs: of the client and the recording.
        efficiency: of the later frames.
        views: cameras of the recording over cameras of the clip.
        options: the recording.
    """
    share = options.long_frames / workers
    return {
        "start": run.start,
        "first": views * run.common,
        "seam": views * run.seam / efficiency,
        "reading": views * costs.read * share,
        "frames": views * run.later * share / efficiency,
        "tasks": costs.trip * share / TASK_FRAMES,
        "client": (run.num_bytes / options.link + costs.client) * options.long_frames,
    }


def model(runs: list[Run], costs: Costs, capture: Capture, options: Options) -> list[dict[str, Any]]:
    """Return the modelled fits: workers, seconds, the stages, efficiency and bottleneck."""
    (one,) = (run for run in runs if run.workers == 1)
    efficiency = min(one.later / run.later for run in runs)
    views = options.long_cameras / len(capture.cameras)
    rows = []
    alone = sum(stages(1, one, costs, 1.0, views, options).values())
    for workers in options.modelled:
        found = stages(workers, one, costs, efficiency, views, options)
        seconds = sum(found.values())
        rows.append(
            {
                "workers": workers,
                "seconds": seconds,
                "stages": found,
                "efficiency": alone / (workers * seconds),
                "bottleneck": max(found.keys() - _SHORTENED, key=lambda name: found[name]),
            }
        )
    return rows


def efficiencies(runs: list[Run]) -> list[dict[str, float]]:
    """Return the efficiency of each number of workers: of the later frames, and of the whole fit."""
    (one,) = (run for run in runs if run.workers == 1)
    return [
        {
            "workers": run.workers,
            "frames": one.later / run.later,
            "whole": one.seconds / (run.workers * run.seconds),
        }
        for run in runs
    ]


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw the measured efficiency beside the modelled one, and the modelled stages."""
    figure = blank_figure(9, 3.6)
    left, right = figure.subplots(1, 2)
    measured, rows = figures["efficiency"], figures["model"]
    for name, style in (("frames", "o-"), ("whole", "s-")):
        values = [row[name] for row in measured]
        left.plot([row["workers"] for row in measured], values, style, label=f"measured, {name}")
    left.plot(
        [row["workers"] for row in rows], [row["efficiency"] for row in rows], "^--", label="model, long recording"
    )
    left.set(xscale="log", xlabel="workers", ylabel="efficiency", ylim=(0, 1.1))
    left.legend(fontsize=7)
    bottom = np.zeros(len(rows))
    positions = np.arange(len(rows))
    for name in rows[0]["stages"]:
        shares = np.array([row["stages"][name] / row["seconds"] for row in rows])
        right.bar(positions, shares, bottom=bottom, label=name)
        bottom += shares
    for position, row in zip(positions, rows, strict=True):
        text = f"{row['seconds'] / 3600:.1f} h\nbottleneck: {row['bottleneck']}"
        right.annotate(text, (position, 1.01), ha="center", va="bottom", fontsize=7)
    right.set_xticks(positions, [str(row["workers"]) for row in rows])
    right.set(xlabel="workers, model", ylabel="share of the wall time", ylim=(0, 1.15))
    right.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    save_figure(figure, path)


def main(options: Options) -> None:
    """Measure, model and draw."""
    mi.set_variant("llvm_ad_rgb")
    with TemporaryDirectory() as name:
        folder = Path(name)
        size = SynthConfig(options.cameras, options.frames, options.width, options.width * 3 // 4)
        synthesize(options.scene, folder / "clip", size)
        capture = load_capture(folder / "clip")
        runs, costs = measure(capture, options, folder)
    figures = {
        "options": asdict(replace(options, json=None, plot=None)),
        "runs": [asdict(run) for run in runs],
        "costs": asdict(costs),
        "efficiency": efficiencies(runs),
        "model": model(runs, costs, capture, options),
    }
    options.write(figures)
    if options.plot is not None:
        draw(figures, options.plot)


if __name__ == "__main__":
    main(tyro.cli(Options))

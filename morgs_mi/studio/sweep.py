"""Error against run time of a capture: fits with several numbers of epochs and several seeds, and
their scores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import islice, product
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge

from morgs_mi.capture.capture import Capture
from morgs_mi.core.config import check_value
from morgs_mi.core.environment import machine, versions
from morgs_mi.core.files import write_json
from morgs_mi.core.plots import check_plot, save_plot
from morgs_mi.core.progress import Progress, Report
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.evaluate.results import known_mean
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.runs.fit_capture import stream_capture
from morgs_mi.stream_loop import StreamLoop

Scores = Mapping[str, float]

# The first and two later frames compile the kernels of a fit.
_WARM_FRAMES = 3
_WARM_STEPS = 60
SCORES = {
    "first_seconds": ("first, s", 1),
    "later_seconds": ("later, s", 2),
    "bytes_per_frame": ("bytes", 0),
    "psnr": ("PSNR, dB", 2),
    "psnr_moving": ("moving, dB", 2),
    "motion_error_moving": ("motion error, px", 2),
    "confidence_iou": ("IoU", 2),
}
"""Titles and digits of the scores of a fit, by name; seconds and bytes are of a frame."""


def sweep(
    capture: Capture,
    out: str | Path,
    epochs: Sequence[int],
    seeds: int = 1,
    config: StreamConfig | None = None,
    progress: Report | None = None,
) -> list[Scores]:
    """Fit and evaluate a capture with each number of epochs and each of the seeds 0, 1, ....

    Kernels are compiled before the first fit. OUT/epochs4-seed0 etc. have the streams,
    OUT/sweep.json the scores.

    Returns:
        The number of epochs, seed, seconds, bytes and mean scores of each fit, by name; NaN where
        they are unknown.

    Raises:
        ValueError: a number is below 1, or as `stream_capture`.
        OSError: as `stream_capture`.
    """
    for name, value in (("seeds", seeds), *(("epochs", value) for value in epochs)):
        check_value("sweep()", name, value, Annotated[int, Ge(1)])
    config = config or StreamConfig()
    _compile_kernels(capture, config)
    rows: list[Scores] = []
    ladder = list(product(dict.fromkeys(epochs), range(seeds)))
    stage = Progress(progress, "Fitting and evaluating")
    for count, seed in ladder:
        stage(len(rows), len(ladder))
        settings = replace(config, fit=replace(config.fit, epochs=count), seed=seed)
        folder = Path(out) / f"epochs{count}-seed{seed}"
        stream_capture(capture, folder, settings)
        result = evaluate_stream(folder, capture.path)
        values = {
            **asdict(result.scores),
            "first_seconds": result.seconds.first,
            "later_seconds": result.seconds.per_later_frame,
            "bytes_per_frame": result.sizes.per_frame,
        }
        scores = {name: values[name] for name in SCORES}
        rows.append({"epochs": count, "seed": seed, **scores})
        results = {"rows": rows, "machine": machine(), "versions": versions()}
        write_json(Path(out) / "sweep.json", results)
    stage(len(rows), len(ladder))
    return rows


def _compile_kernels(capture: Capture, config: StreamConfig) -> None:
    """Fit the first frames in few steps and discard the result."""
    fit = replace(config.fit, first_frame_steps=_WARM_STEPS, epochs=1)
    loop = StreamLoop.of(capture, replace(config, fit=fit))
    for frame in islice(capture.partial_frames(), _WARM_FRAMES):
        loop.push([frame.images[view] for view in capture.train_views])


def mean_scores(rows: Sequence[Scores]) -> list[Scores]:
    """Return the means over the seeds, for each number of epochs."""
    means = []
    for epochs in dict.fromkeys(row["epochs"] for row in rows):
        group = [row for row in rows if row["epochs"] == epochs]
        means.append({name: known_mean([row[name] for row in group]) for name in group[0]})
    return means


def write_sweep_plot(path: Path, rows: Sequence[Scores]) -> None:
    """Plot scores and sizes over the seconds of a later frame: a dot for each fit, a line through
    the means.

    Raises:
        ValueError: as `check_plot`.
        OSError: the file cannot be written.
    """
    check_plot(path)
    from matplotlib.figure import Figure

    means = sorted(mean_scores(rows), key=lambda row: row["later_seconds"])
    panels = [name for name in [*SCORES][2:] if np.isfinite(means[0][name])]
    figure = Figure(figsize=(3.6 * len(panels), 3.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        axes.plot([row["later_seconds"] for row in means], [row[name] for row in means])
        axes.plot(
            [row["later_seconds"] for row in rows], [row[name] for row in rows], "o", markersize=4
        )
        for row in means:
            place = (row["later_seconds"], row[name])
            axes.annotate(f"{row['epochs']:.0f}", place, xytext=(4, 4), textcoords="offset points")
        axes.set(xlabel="seconds of a later frame", ylabel=SCORES[name][0])
        axes.grid(color="0.9")
    save_plot(path, figure, "write_sweep_plot()")

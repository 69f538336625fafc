"""Plots of docs/experiments, made from benchmarks/results; the reports draw the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.pages.results import committed
from benchmarks.reports.plots import blank_figure, grouped

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def drift() -> Figure:
    """Return the PSNR where things move over the frames of five clips, means of their fits."""
    figure = blank_figure(7, 3.2)
    axis = figure.subplots()
    clips = grouped(
        [fit for name in ("drift", "drift_fresh") for fit in committed(name)["fits"]], "clip"
    )
    for (name,), fits in clips.items():
        psnr = np.mean([np.array(fit["psnr_moving"], float) for fit in fits], axis=0)
        axis.plot(np.arange(1, len(psnr) + 1), psnr, label=name)
    axis.set(xlabel="frame", ylabel="PSNR where things move, dB")
    axis.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    return figure


def photos_over_time() -> Figure:
    """Return the held-out PSNR of first frames of photos over the processor time that they took."""
    figure = blank_figure(5.5, 3)
    axis = figure.subplots()
    for (name,), fits in grouped(committed("real_seconds")["fits"], "set").items():
        fits = sorted(fits, key=lambda fit: fit["cpu_s"])
        axis.plot(
            [fit["cpu_s"] / 2 for fit in fits], [fit["held_out"] for fit in fits], "o-", label=name
        )
    axis.set(xscale="log", xlabel="processor time of two cores, s", ylabel="held-out PSNR, dB")
    ticks = (30, 60, 120, 300, 600)
    axis.set_xticks(ticks, map(str, ticks))
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    return figure


# Of seconds and of gigabytes.
_TICKS = (0.5, 1, 2, 4, 8)


def growth() -> Figure:
    """Return the seconds and the memory of a later frame over each size of its problem, and over
    the frames of a recording.
    """
    from matplotlib.ticker import EngFormatter

    result = committed("growth")
    figure = blank_figure(11, 4.4)
    columns = figure.subplots(2, len(result["axes"]) + 1, sharey="row").T
    measures = (("seconds", 1, "s"), ("resident", 1e-9, "GB"))
    for (axis, entry), column in zip(result["axes"].items(), columns, strict=False):
        for plot, (name, unit, _) in zip(column, measures, strict=True):
            points = entry["points"]
            sizes = [point[axis] for point in points]
            plot.plot(sizes, [unit * point[name] for point in points], "o-")
            plot.set(xscale="log", yscale="log")
            plot.set_xticks(sizes, [EngFormatter(places=0, sep="")(size) for size in sizes])
            plot.set_title(f"slope {entry['slopes'][name]:.2f}", fontsize=9)
            plot.minorticks_off()
        column[1].set_xlabel(axis)
    frames = range(1, len(result["frames"]) + 1)
    for plot, (name, unit, label), first in zip(columns[-1], measures, columns[0], strict=True):
        plot.plot(frames, [unit * frame[name] for frame in result["frames"]])
        first.set_ylabel(label)
        first.set_yticks(_TICKS, map(str, _TICKS))
    columns[-1][0].set_title("one recording", fontsize=9)
    columns[-1][1].set_xlabel("frame")
    return figure


# Every plot by the name of its file.
PLOTS: Mapping[str, Callable[[], Figure]] = {
    "drift": drift,
    "growth": growth,
    "photos_over_time": photos_over_time,
}

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


# Every plot by the name of its file.
PLOTS: Mapping[str, Callable[[], Figure]] = {
    "drift": drift,
    "photos_over_time": photos_over_time,
}

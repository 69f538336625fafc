"""Plots of docs/experiments, made from benchmarks/results; the reports draw the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.pages.results import CHOSEN_ON, committed
from benchmarks.reports.plots import blank_figure, grouped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PLOTS"]


def drift() -> Figure:
    """Return the PSNR where things move over the frames of five clips, means of their fits."""
    figure = blank_figure(7, 3.2)
    axis = figure.subplots()
    clips = grouped([fit for name in ("drift", "drift_fresh") for fit in committed(name)["fits"]], "clip")
    for (name,), fits in clips.items():
        psnr = np.mean([np.array(fit["psnr_moving"], float) for fit in fits], axis=0)
        axis.plot(np.arange(1, len(psnr) + 1), psnr, label=name)
    axis.set(xlabel="frame", ylabel="PSNR where things move, dB")
    axis.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=8)
    return figure


def estimates() -> Figure:
    """Return the estimated PSNR of views between the cameras over the measured one, by number of cameras."""
    figure = blank_figure(7.5, 3.6)
    fits = committed("estimates")["fits"]
    for axis, chosen in zip(figure.subplots(1, 2, sharey=True), (True, False), strict=True):
        some = [fit for fit in fits if (fit["seed"] in CHOSEN_ON) == chosen]
        for views in sorted({fit["views"] for fit in some}):
            own = [(fit["held_out"], fit["estimate"]) for fit in some if fit["views"] == views]
            axis.plot(*np.transpose(own), ".", label=f"{views} views")
        ends = np.array([34, 47])
        axis.plot(ends, ends, color="0.5", lw=0.8)
        axis.fill_between(ends, ends - 1.5, ends + 1.5, color="0.5", alpha=0.15, lw=0)
        title = "scenes that rules were chosen on" if chosen else "scenes that nothing was chosen on"
        axis.set(xlabel="held-out views, dB", aspect="equal", title=title)
        axis.title.set_size(9)
        axis.grid(alpha=0.3)
    figure.axes[0].set(ylabel="estimate, dB")
    figure.axes[1].legend(fontsize=8)
    return figure


def photos_over_time() -> Figure:
    """Return the held-out PSNR of first frames of photos over the processor time that they took."""
    figure = blank_figure(5.5, 3)
    axis = figure.subplots()
    for (name,), fits in grouped(committed("real_seconds")["fits"], "set").items():
        fits = sorted(fits, key=lambda fit: fit["cpu_s"])
        axis.plot([fit["cpu_s"] / 2 for fit in fits], [fit["held_out"] for fit in fits], "o-", label=name)
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
    "estimates": estimates,
    "photos_over_time": photos_over_time,
}

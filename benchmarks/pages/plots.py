"""Plots of docs/experiments, made from benchmarks/results; the reports draw the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.pages.results import committed
from benchmarks.reports.plots import blank_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Published means over N3DV's scenes, dB and seconds a frame on a GPU.
_N3DV = {"3DGStream": (31.67, 13), "HiCoM": (31.17, 11), "QUEEN-l": (32.19, 2.9)}
_N3DV |= {"MoRGS": (32.53, 4.0)}
# Published PSNR of basketball, dB, without seconds (table 9 of the HiCoM paper).
_BASKETBALL = {"HiCoM, colours corrected": 28.60, "HiCoM": 27.29}
_BELOW = "3DGStream, GPU: 20.01 dB, far below"


def against_the_field() -> Figure:
    """Return the PSNR of held-out views over the seconds of a frame: ours for every frame of
    basketball, and what other methods publish, on GPUs.
    """
    figure = blank_figure(11, 3)
    ours, theirs = figure.subplots(1, 2, sharex=True)
    frames = next(
        fit["frames"] for fit in committed("held_out")["fits"] if fit["recording"] == "basketball"
    )
    seconds, psnr = np.array([(frame["seconds"], frame["psnr"]) for frame in frames]).T
    ours.plot(seconds, psnr, ".", color="C0", alpha=0.3, label="ours, two CPU cores: frames")
    ours.plot(seconds.mean(), psnr.mean(), "D", color="black", label="their mean")
    for name, value in _BASKETBALL.items():
        ours.axhline(value, color="C1", linestyle="--")
        ours.annotate(f"{name}, GPU", (115, value - 0.05), va="top", ha="right", fontsize=8)
    ours.annotate(_BELOW, (115, 26.55), ha="right", fontsize=8)
    ours.set(title="basketball", ylabel="PSNR of held-out views, dB", ylim=(26.5, 29.2))
    for name, (value, duration) in _N3DV.items():
        theirs.plot(duration, value, "s", color="C1")
        theirs.annotate(
            f"{name}, GPU", (duration, value), (6, 0), textcoords="offset points", fontsize=8
        )
    speed = committed("frame_speed")["n3dv"]["runs"]["default, 2 epochs"]["seconds"]
    theirs.axvline(speed, color="C0", linestyle=":")
    theirs.annotate("ours, two CPU cores: seconds alone", (speed * 1.1, 31.35), fontsize=8)
    theirs.set(title="N3DV, means of its scenes", ylim=(31, 33))
    ticks = (1, 3, 10, 30, 100)
    for axis in (ours, theirs):
        axis.set(xscale="log", xlim=(0.8, 130), xlabel="seconds a frame")
        axis.set_xticks(ticks, map(str, ticks))
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    ours.legend(loc="center left", fontsize=8)
    return figure


# Every plot by the name of its file.
PLOTS: Mapping[str, Callable[[], Figure]] = {
    "against_the_field": against_the_field,
}

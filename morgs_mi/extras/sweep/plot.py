"""Plot of a sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from morgs_mi.extras.sweep.sweep import SweepResult

# Of Okabe and Ito, which readers with any vision of colours distinguish.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# Titles of the panels, by the scores' indices.
_PANELS = {
    2: "PSNR, dB",
    3: "PSNR of moving pixels, dB",
    4: "motion error of moving pixels, px",
    5: "size, kB",
}
_FIRST = "PSNR of the first frame, dB"
# Inches.
_WIDTH = 9.0
_HEIGHT = 3.3  # of a panel
# Least range of an axis of PSNR, dB, and least ratio of the ends of an axis of seconds.
_LEAST_DB = 3.0
_LEAST_RATIO = 6.0
# Least distance of two names, as a share of the height of a panel.
_DISTANCE = 0.08

# Seconds and scores [P, S] of P points of a curve and S seeds, and a label of each point.
Curve = tuple[np.ndarray, np.ndarray, Sequence[Any] | np.ndarray]


def draw_sweep(result: SweepResult) -> Figure:
    """Return the plot of a sweep: the scores over the seconds of a later frame, a curve for each
    arm, and the PSNR of the first frame over the seconds since its fit began.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    panels: dict[str, dict[str, Curve]] = {}
    for k, title in _PANELS.items():
        if np.isfinite(result.scores[..., k]).any():
            panels[title] = {}
            for name in result.arms:
                rows = np.flatnonzero(np.array(result.arms) == name)
                x, y = result.scores[rows][..., [1, k]].transpose(2, 0, 1)
                panels[title][name] = x, y, np.array(result.epochs)[rows]
    # Seeds may balance exposures in different numbers of rounds, which come first.
    count = min(len(curve) for curve in result.first_frames)
    first_frames = [curve[-count:] for curve in result.first_frames]
    panels[_FIRST] = {"first frame": (*np.transpose(first_frames, (2, 1, 0)), ())}
    lines = -(-len(panels) // 2)
    figure = Figure((_WIDTH, _HEIGHT * lines), layout="constrained")
    views = "held-out" if result.held_out else "training"
    seeds = len(result.first_frames)
    title = f"{result.capture}, {views} views; numbers: epochs"
    bars = f"; bars: standard deviation over {seeds} seeds"
    figure.suptitle(title + bars * (seeds > 1), parse_math=False)
    for place, (title, curves) in enumerate(panels.items(), 1):
        draw_curves(figure.add_subplot(lines, 2, place), title, curves)
    return figure


def draw_curves(axes: Any, title: str, curves: Mapping[str, Curve]) -> None:
    """Draw a score over seconds, a curve for each arm with its name at the end."""
    ends = []
    for color, (name, (x, y, labels)) in zip(cycle(_COLORS), curves.items(), strict=False):
        errors = (values.std(1, ddof=1) if values.shape[1] > 1 else None for values in (y, x))
        x = x.mean(1)
        y = y.mean(1)
        axes.errorbar(x, y, *errors, color=color, marker="o", markersize=4, capsize=2)
        for label, *place in zip(labels, x, y, strict=False):
            axes.annotate(label, place, (0, 5), textcoords="offset points", color=color, fontsize=7)
        ends.append((y[-1], x[-1], name, color))
    axes.set_xscale("log", subs=[2, 5])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    low, high = axes.get_xlim()
    margin = max(_LEAST_RATIO * low / high, 1) ** 0.5
    axes.set_xlim(low / margin, high * margin)
    axes.margins(y=0.15)
    low, high = axes.get_ylim()
    margin = max(_LEAST_DB - (high - low), 0) / 2
    low, high = (low - margin, high + margin) if title.endswith("dB") else (0, 1.05 * high)
    axes.set_ylim(low, high)
    axes.set_title(title, loc="left")
    axes.set_xlabel("seconds since its start" if title == _FIRST else "seconds of a later frame")
    axes.grid(color="0.9")
    # Names beside the panel, in the order of the ends and apart from each other.
    ends.sort()
    shifts = _DISTANCE * np.arange(len(ends))
    heights = (np.array([end[0] for end in ends]) - low) / (high - low) - shifts
    heights = np.maximum.accumulate(np.minimum(heights, 1 - shifts[-1])) + shifts
    for height, (y, x, name, color) in zip(heights, ends, strict=True):
        place = (1.03, height)
        axes.annotate(
            shorten(name, 24),
            (x, y),
            place,
            "data",
            "axes fraction",
            {"arrowstyle": "-", "color": color, "linewidth": 0.5, "relpos": (0, 0.5)},
            color=color,
            va="center",
        )

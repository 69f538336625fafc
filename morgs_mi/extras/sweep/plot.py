"""Plots of a sweep."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from morgs_mi.extras.sweep.report import AXES, select_names
from morgs_mi.extras.sweep.statistics import DECIDING, INDEX, SCORES, mean_of
from morgs_mi.extras.sweep.sweep_scores import SweepScores
from morgs_mi.platform.plots import label_ends

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of Okabe and Ito, which readers with any vision of colours distinguish.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
# Of changes that decide, and of others.
_DECISIVE = "#D55E00"
_OTHER = "#0072B2"
# Scores over the seconds of a later frame, beside the measure.
_PANELS = ("psnr", "psnr_moving", "motion_error_moving", "kilobytes")
# Inches.
_WIDTH = 9.0
_HEIGHT = 3.3  # of a panel
_ROW = 0.28  # of a part
_FRAME = 1.4  # of titles and axes
# Least range of an axis of PSNR, dB, and least ratio of the ends of an axis of seconds.
_LEAST_DB = 3.0
_LEAST_RATIO = 6.0
# Standard errors of the bars of changes: those that a decisive change exceeds.
_BARS = 2


def draw_sweep(result: SweepScores) -> Figure:
    """Return the plot of a sweep: the measure over the seconds of the first frame, and the scores
    over those of a later frame, a curve for each config.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    later_rows = np.concatenate([np.zeros(0, int), *result.curves(False).values()])
    scores = select_names((result.measure, *_PANELS), mean_of(result.scores).mean[later_rows])
    panels = [(False, name) for name in scores]
    if result.curves(True):
        panels.append((True, result.measure))
    lines = -(-max(len(panels), 1) // 2)
    figure = Figure((_WIDTH, _HEIGHT * lines), layout="constrained")
    remark = "numbers: epochs or steps; bars: standard errors"
    figure.suptitle(_title(result, remark), parse_math=False)
    for place, (first_alone, name) in enumerate(panels, 1):
        draw_curves(figure.add_subplot(lines, 2, place), result, first_alone, name)
    return figure


def draw_curves(axes: Any, result: SweepScores, first_alone: bool, name: str) -> None:
    """Draw a score over seconds, a curve for each config with its name at the end."""
    score = SCORES[name]
    title, _, seconds = AXES[first_alone]
    means = mean_of(result.scores)
    points = np.stack([means.mean[:, INDEX[seconds]], means.mean[:, INDEX[name]]], 1)
    ends = []
    for k, (label, rows) in enumerate(result.curves(first_alone).items()):
        color = _COLORS[k % len(_COLORS)]
        errors = means.error[rows][:, [INDEX[name], INDEX[seconds]]].T
        style = {"color": color, "marker": "o", "markersize": 4, "capsize": 2}
        axes.errorbar(*points[rows].T, *errors, **style)
        for row in rows:
            place = {"xytext": (0, 5), "textcoords": "offset points", "fontsize": 7}
            axes.annotate(result.points[row], points[row], color=color, **place)
        ends.append((label.replace(" and ", "\nand "), tuple(points[rows[-1]]), color))
    axes.set_xscale("log", subs=[2, 5])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    low, high = axes.get_xlim()
    margin = max(_LEAST_RATIO * low / high, 1) ** 0.5
    axes.set_xlim(low / margin, high * margin)
    axes.margins(y=0.15)
    low, high = axes.get_ylim()
    margin = max(_LEAST_DB - (high - low), 0) / 2
    low, high = (low - margin, high + margin) if score.unit == "dB" else (low, high)
    axes.set_ylim(low, high)
    axes.set_title(f"{score.label}: {title}", loc="left", fontsize="medium")
    axes.set_xlabel(f"{title}, s")
    axes.grid(color="0.9")
    label_ends(axes, ends)


def draw_changes(result: SweepScores) -> Figure:
    """Return the plot of `leave_out`: the changes of the scores without each part; those that
    decide that it is needed have another colour.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    rows = result.ablations
    changes = result.changes
    names = select_names(DECIDING, changes.mean[rows])
    figure = Figure((_WIDTH, _FRAME + _ROW * len(rows)), layout="constrained")
    remark = "orange: needed because of it; bars: twice the standard errors"
    figure.suptitle(_title(result, remark), parse_math=False)
    heights = -np.arange(len(rows))
    labels = np.char.replace(result.names, "without ", "")[rows]
    first_axes = None
    for place, name in enumerate(names, 1):
        axes = figure.add_subplot(1, len(names), place, sharey=first_axes)
        first_axes = first_axes or axes
        decides = result.excess[rows, DECIDING.index(name)] > 1
        values = changes.mean[rows, INDEX[name]]
        errors = _BARS * changes.error[rows, INDEX[name]]
        colors = np.where(decides, _DECISIVE, _OTHER)
        axes.axvline(0, color="0.5", linewidth=1)
        axes.hlines(heights, values - errors, values + errors, colors.tolist())
        axes.scatter(values, heights, 20, colors)
        axes.set_yticks(heights, labels)
        axes.tick_params(labelleft=place == 1)
        axes.set_title(f"{SCORES[name].title}\n{SCORES[name].unit}", fontsize="medium")
        axes.grid(color="0.9")
    return figure


def _title(result: SweepScores, remark: str) -> str:
    """Return the title of a plot: what was fitted, and a remark."""
    views = "held-out" if result.held_out else "training"
    return f"{result.capture}, {views} views, seeds: {result.scores.shape[1]}; {remark}"

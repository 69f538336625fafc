"""Files of plots, and the names of curves in them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.platform.checks import require
from morgs_mi.platform.files import atomic_path

_SUFFIXES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")
# Least distance of two names, as a share of the height of a panel.
_DISTANCE = 0.08


def check_plot(path: Path) -> None:
    """Check that a plot can be written.

    Raises:
        ValueError: the name has another suffix, or matplotlib is not installed.
    """
    suffix = path.suffix.lower()
    requirement = "the suffix of a plot must be .png, .jpg, .svg or .pdf"
    require(suffix in _SUFFIXES, path, requirement, repr(suffix), "rename it")
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ValueError(
            f"{path}: a plot needs the package matplotlib; pip install 'morgs-mi[plots]'."
        ) from None


def save_plot(path: Path, figure: Any, place: str) -> None:
    """Write a figure of matplotlib atomically, in the format of the name.

    Raises:
        OSError: the file cannot be written; its sentence begins with `place`.
    """
    with atomic_path(path, place, parents=True) as partial:
        figure.savefig(partial, format=path.suffix[1:].lower())


def label_ends(axes: Any, ends: Sequence[tuple[str, tuple[float, float], str]]) -> None:
    """Write the names of curves beside their panel, in the order of the curves' ends and apart from
    each other, with a line to each end.

    Args:
        axes: panel of matplotlib with its final scales; its limits are fixed.
        ends: name, position (x, y) of the end, and colour of each curve; at least one.
    """
    axes.set_xlim(axes.get_xlim())  # limits that are asked for are up to date
    axes.set_ylim(axes.get_ylim())
    to_panel = axes.transData + axes.transAxes.inverted()
    heights = to_panel.transform([end for _, end, _ in ends])[:, 1]
    order = np.argsort(heights, kind="stable")
    shifts = _DISTANCE * np.arange(len(ends))
    free = np.minimum(heights[order] - shifts, 1 - shifts[-1])
    for height, k in zip(np.maximum.accumulate(free) + shifts, order.tolist(), strict=True):
        name, end, color = ends[k]
        axes.annotate(
            name,
            end,
            (1.03, height),
            "data",
            "axes fraction",
            {"arrowstyle": "-", "color": color, "linewidth": 0.5, "relpos": (0, 0.5)},
            color=color,
            va="center",
        )

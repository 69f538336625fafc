"""Markdown tables and plots of the reports."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["blank_figure", "grouped", "label_points", "markdown", "plus_minus", "save_figure"]


def markdown(titles: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table; its first `left` columns are aligned left, the others right."""
    rule = "|---" * left + "|---:" * (len(titles) - left) + "|"
    lines = [f"| {' | '.join(cells)} |" for cells in (titles, *rows)]
    return "\n".join([lines[0], rule, *lines[1:]]) + "\n"


def grouped(fits: Iterable[Mapping[str, Any]], *keys: str) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Return the fits that have the values of `keys` in common, by these values, lists as tuples."""
    groups: dict[tuple[Hashable, ...], list[Mapping[str, Any]]] = {}
    for fit in fits:
        values = (tuple(value) if isinstance(value := fit[key], list) else value for key in keys)
        groups.setdefault(tuple(values), []).append(fit)
    return groups


def plus_minus(values: Sequence[float], digits: int = 2) -> str:
    """Return the mean and the standard deviation of some fits, which is 0 for a single one."""
    deviation = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return f"{np.mean(values):.{digits}f} ± {deviation:.{digits}f}"


def blank_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display; sizes in inches.

    Raises:
        ValueError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ValueError("plot: expected matplotlib, found none; install it: pip install matplotlib.") from error
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as .png or .svg.

    Raises:
        OSError: the file cannot be written.
    """
    figure.savefig(path, dpi=90)


def label_points(
    axis: Any, points: Iterable[tuple[float, float]], names: Iterable[str], shift: tuple[float, float], size: float = 7
) -> None:
    """Write a name beside each point, offset by `shift` typographic points."""
    for name, point in zip(names, points, strict=True):
        axis.annotate(name, point, xytext=shift, textcoords="offset points", fontsize=size)

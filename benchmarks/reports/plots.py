"""Markdown tables and plots of the reports."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from morgs_mi.evaluate.tables import figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Column(NamedTuple):
    """Column of a table of scores.

    Attributes:
        title: head of the column.
        score: name of the score.
        decimals: number of decimals.
        factor: factor on the score.
        spread: whether the standard deviation follows the mean.
    """

    title: str
    score: str
    decimals: int = 2
    factor: float = 1
    spread: bool = True

    def of(self, rows: Sequence[Mapping[str, Any]]) -> str:
        """Return the figure of some rows, "-" where one has no such score."""
        values = self.factor * np.array([row.get(self.score, np.nan) for row in rows], float)
        if self.spread and np.isfinite(values).all():
            return plus_minus(values, self.decimals)
        return figure(float(values.mean()), self.decimals)


def scores_table(
    rows: Iterable[Mapping[str, Any]],
    keys: Mapping[str, str],
    columns: Sequence[Column],
) -> str:
    """Return the scores of a study in Markdown: one line for all rows that have the keys in common.

    Args:
        rows: rows of a study.
        keys: names of the keys by the titles of the first columns.
        columns: of the scores.
    """
    lines = [
        (*map(str, values), *(column.of(group) for column in columns))
        for values, group in grouped(rows, *keys.values()).items()
    ]
    return markdown((*keys, *(column.title for column in columns)), lines)


def means_over(rows: Sequence[Mapping[str, Any]], key: str, **about: Any) -> list[dict[str, Any]]:
    """Return the means of the numbers of the rows that have `key` in common, as rows with the
    entries `about`.
    """
    means = []
    for (value,), group in grouped(rows, key).items():
        names = [
            name
            for name, entry in group[0].items()
            if isinstance(entry, Real) and name not in (key, *about)
        ]
        table = {name: np.array([row[name] for row in group], float) for name in names}
        means.append(
            {
                key: value,
                **about,
                **{name: float(np.nanmean(column)) for name, column in table.items()},
            }
        )
    return means


def markdown(titles: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table; its first `left` columns are aligned left, the others right."""
    rule = "|---" * left + "|---:" * (len(titles) - left) + "|"
    lines = [f"| {' | '.join(cells)} |" for cells in (titles, *rows)]
    return "\n".join([lines[0], rule, *lines[1:]]) + "\n"


def grouped(
    fits: Iterable[Mapping[str, Any]], *keys: str
) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Return the fits that share the values of `keys`, by these values."""
    groups: dict[tuple[Hashable, ...], list[Mapping[str, Any]]] = {}
    for fit in fits:
        groups.setdefault(tuple(fit[key] for key in keys), []).append(fit)
    return groups


def plus_minus(values: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """Return the mean and the standard deviation of some fits, which is 0 for a single one."""
    deviation = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return f"{np.mean(values):.{digits}f} ± {deviation:.{digits}f}"


def span(values: Iterable[float], digits: int = 1) -> str:
    """Return the smallest and the largest value, or the only one."""
    numbers = sorted(values)
    least = f"{numbers[0]:.{digits}f}"
    most = f"{numbers[-1]:.{digits}f}"
    return least if least == most else f"{least} to {most}"


def blank_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display; sizes in inches.

    Raises:
        ValueError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ValueError(
            "plot: expected matplotlib, found none; install it: pip install matplotlib."
        ) from error
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as .png or .svg.

    Raises:
        OSError: the file cannot be written.
    """
    figure.savefig(path, dpi=90)

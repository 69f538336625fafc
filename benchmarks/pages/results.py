"""Committed results, and means and spreads over their fits."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reports.plots import grouped, plus_minus

__all__ = ["CHOSEN_ON", "Scores", "committed", "fits_by_cell", "means_over_cells", "span", "spreads"]

RESULTS = Path(__file__).parents[1] / "results"
Scores = Mapping[str, Any]
# Seeds of the scenes on which the rules of the estimates were chosen.
CHOSEN_ON = (0, 2, 4, 6, 7, 13, 36, 37)


def committed(name: str) -> Any:
    """Return the content of benchmarks/results/NAME.json."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def fits_by_cell(fits: Mapping[str, Scores], separator: str = "/") -> dict[str, list[Scores]]:
    """Return the fits of each cell: their names without the seed of the fit, which comes last."""
    cells: dict[str, list[Scores]] = {}
    for name, scores in fits.items():
        cells.setdefault(name.rpartition(separator)[0], []).append(scores)
    return cells


def means_over_cells(fits: Mapping[str, Scores], names: Sequence[str]) -> list[dict[str, float]]:
    """Return the means of some scores over the cells, for each seed of a fit."""
    own = [{"fit": name.rpartition("/")[2], **scores} for name, scores in fits.items()]
    return [
        {name: float(np.mean([fit[name] for fit in group])) for name in names} for group in grouped(own, "fit").values()
    ]


def spreads(fits: Sequence[Scores], digits: Mapping[str, int]) -> list[str]:
    """Return mean and standard deviation of some scores, given with their numbers of decimals."""
    return [plus_minus([fit[name] for fit in fits], count) for name, count in digits.items()]


def span(values: Iterable[float], digits: int = 1) -> str:
    """Return the smallest and the largest value, or the only one."""
    ordered = sorted(values)
    low, high = f"{ordered[0]:.{digits}f}", f"{ordered[-1]:.{digits}f}"
    return low if low == high else f"{low} to {high}"

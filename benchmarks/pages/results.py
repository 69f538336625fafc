"""Committed results, and ranges of their figures."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

__all__ = ["Scores", "committed", "span"]

RESULTS = Path(__file__).parents[1] / "results"
Scores = Mapping[str, Any]


def committed(name: str) -> Any:
    """Return the content of benchmarks/results/NAME.json."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def span(values: Iterable[float], digits: int = 1) -> str:
    """Return the smallest and the largest value, or the only one."""
    ordered = sorted(values)
    low, high = f"{ordered[0]:.{digits}f}", f"{ordered[-1]:.{digits}f}"
    return low if low == high else f"{low} to {high}"

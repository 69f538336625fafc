"""Pages of experiments, which the tests compare with the committed results."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[3]


def page(name: str) -> str:
    """Return the text of a page in docs/experiments/."""
    return (ROOT / "docs/experiments" / name).read_text(encoding="utf-8")

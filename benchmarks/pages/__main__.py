"""Write the tables and plots of docs/experiments from benchmarks/results.

    python -m benchmarks.pages

A table follows its name in a comment, `<!-- table: NAME -->`, and is replaced. A test compares the
pages with the committed results.
"""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.pages.plots import PLOTS
from benchmarks.pages.tables import TABLES
from benchmarks.reports.plots import save_figure

PAGES = Path(__file__).parents[2] / "docs/experiments"


def with_tables(text: str) -> str:
    """Return the text of a page with its tables made from the committed results.

    Raises:
        KeyError: a table has a name that `TABLES` does not have.
    """
    return re.sub(
        r"<!-- table: (\w+) -->\n\n(?:(?:\|.*\n)+\n)?",
        lambda match: f"<!-- table: {match[1]} -->\n\n{TABLES[match[1]]()}\n",
        text,
    )


def main() -> None:
    """Write the pages and their plots."""
    for path in sorted(PAGES.glob("*.md")):
        path.write_text(with_tables(path.read_text(encoding="utf-8")), encoding="utf-8")
    for name, plot in PLOTS.items():
        save_figure(plot(), PAGES / f"{name}.png")


if __name__ == "__main__":
    main()

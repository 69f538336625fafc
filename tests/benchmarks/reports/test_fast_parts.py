"""Report on fast parts: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.fast_parts import search_table
from tests.benchmarks.reports.pages import ROOT, page


def test_unseen_scenes_page__quotes_the_committed_table_of_the_search() -> None:
    committed = json.loads((ROOT / "benchmarks" / "results" / "fast_parts.json").read_text())
    assert search_table(committed["fits"]) in page("unseen-scenes.md")

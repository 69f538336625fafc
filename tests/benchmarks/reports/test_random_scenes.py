"""Report on random scenes: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.random_scenes import scenes_table
from tests.benchmarks.reports.pages import ROOT, page


def test_unseen_scenes_page__quotes_the_committed_table() -> None:
    committed = json.loads((ROOT / "benchmarks" / "results" / "random_scenes.json").read_text())
    assert scenes_table(committed["fits"]) in page("unseen-scenes.md")

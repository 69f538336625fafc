"""Report on drift: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.drift import drift_table
from tests.benchmarks.reports.pages import ROOT, page


def test_unseen_scenes_page__quotes_the_committed_table() -> None:
    committed = json.loads((ROOT / "benchmarks" / "results" / "drift_fresh.json").read_text())
    assert drift_table(committed["clips"]) in page("unseen-scenes.md")

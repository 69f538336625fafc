"""Report on live fits: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.live import epochs_table, strides_table
from tests.benchmarks.reports.pages import ROOT, page


def test_live_page__quotes_the_committed_tables() -> None:
    committed = json.loads((ROOT / "benchmarks" / "results" / "live.json").read_text())
    assert strides_table(committed["fits"], committed["gap"]) in page("live.md")
    assert epochs_table(committed["fits"], committed["gap"]) in page("live.md")

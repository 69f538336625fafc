"""Report on few views: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.few_views import points_table
from tests.benchmarks.reports.pages import ROOT, page


def test_generalise_page__quotes_the_committed_table_of_points() -> None:
    committed = json.loads((ROOT / "benchmarks" / "results" / "few_views_points.json").read_text())
    assert points_table(committed["fits"]) in page("generalise.md")

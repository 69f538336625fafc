"""Report on dropping: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.generalise import choice_table
from tests.benchmarks.reports.pages import ROOT, page


def test_generalise_page__quotes_the_committed_choices() -> None:
    committed = json.loads((ROOT / "benchmarks" / "results" / "generalise.json").read_text())
    assert choice_table(committed["fits"]) in page("generalise.md")

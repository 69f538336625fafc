"""Report on the estimates of other views: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.estimates import estimates_table, within
from tests.benchmarks.reports.pages import ROOT, page

CHOSEN_ON = (0, 2, 4, 6, 7, 13, 36, 37)


def test_first_frame_page__quotes_the_committed_estimates() -> None:
    fits = json.loads((ROOT / "benchmarks" / "results" / "estimates.json").read_text())["fits"]
    for of_choice in (True, False):
        some = [fit for fit in fits if (fit["seed"] in CHOSEN_ON) == of_choice]
        assert estimates_table(some) in page("first-frame.md")
        right, count = within(some, 1.5)
        assert (f"{right} of {count} estimates" if of_choice else f"{right} of {count} are") in page("first-frame.md")

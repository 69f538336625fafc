"""Report on few views: the page that quotes the committed figures."""

from __future__ import annotations

import json

from benchmarks.reports.few_views import dropping_table, forecast_table, points_table
from tests.benchmarks.reports.pages import ROOT, page


def committed(name: str) -> list[dict]:
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text())["fits"]


def test_generalise_page__quotes_the_committed_table_of_points() -> None:
    assert points_table(committed("few_views_points")) in page("generalise.md")


def test_generalise_page__quotes_the_committed_table_of_noisy_views() -> None:
    assert dropping_table(committed("few_views_noisy")) in page("generalise.md")


def test_generalise_page__quotes_the_committed_forecasts() -> None:
    fits = committed("few_views")
    real = [fit for fit in fits if fit["capture"] == "walk4"]
    chosen_on = [fit for fit in fits if fit["capture"][-2:] in ("-0", "-1", "-2")]
    others = [fit for fit in fits if fit not in chosen_on and fit not in real]
    assert forecast_table(chosen_on) in page("generalise.md")
    assert forecast_table(others) + forecast_table(real).splitlines()[-1] in page("generalise.md")

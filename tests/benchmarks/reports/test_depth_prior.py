"""Report on the depth prior: the page that quotes the committed figures."""

from __future__ import annotations

import json

import pytest

from benchmarks.reports.depth_prior import errors_table
from tests.benchmarks.reports.pages import ROOT, page


@pytest.mark.parametrize("name", ["depth_prior", "depth_prior_noisy"])
def test_first_frame_page__quotes_the_committed_depth_priors(name: str) -> None:
    committed = json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text())
    assert errors_table(committed["fits"]) in page("first-frame.md")

"""The report on stability has the cases of the tests, and its committed rows keep their bounds."""

import json
import re

import pytest

from benchmarks.pages.results import committed
from benchmarks.reports import stability
from tests.scenes.extremes import CASES, DISTANCES, NEEDLES, REFUSED
from tests.scenes.hard_fits import HARD_FITS


def test_stability__committed_rows_are_within_the_bounds_of_the_tests():
    rows = {(row["kind"], row.get("name")): row for row in committed("stability")["rows"]}
    cases = {name: row for (_, name), row in rows.items() if "image" in row and name}
    assert cases.keys() == {case.name for case in CASES}
    for case in CASES:
        row = cases[case.name]
        assert row["image"] < case.image, case.name
        assert max(row[name] for name in stability.ATTRIBUTES) < case.gradient, case.name
    for name, (_, message) in REFUSED.items():
        assert re.search(message, rows["refused", name]["sentence"])
    for fit in HARD_FITS:
        row = rows["fit", fit.name]
        assert (row["frames"], row["finite"]) == (fit.num_frames, True)
        assert min(row["psnr"]) > fit.psnr


@pytest.mark.slow
def test_stability__writes_rows(tmp_path, monkeypatch):
    ladders = [NEEDLES[1.0], NEEDLES[10.0], DISTANCES[1.0], DISTANCES[10.0]]
    monkeypatch.setattr(stability, "CASES_BY_KIND", {"ladders": ladders})
    monkeypatch.setattr(stability, "HARD_FITS", HARD_FITS[2:3])
    monkeypatch.setattr(stability, "million_on_a_pixel", lambda: {"image": 1e-6, "means": 1e-5})
    stability.Options(tmp_path / "a.json", tmp_path / "a.png", frames=2).run()
    result = json.loads((tmp_path / "a.json").read_text())
    assert len(result["rows"]) == 4 + len(REFUSED) + 1 + 1
    assert {"machine", "versions", "commit", "date"} <= result.keys()
    assert (tmp_path / "a.png").stat().st_size > 1000

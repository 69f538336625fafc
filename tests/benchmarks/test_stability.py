"""The report on stability writes its rows."""

import pytest

from benchmarks.reports import stability
from morgs_mi.platform.bounded import read_json
from tests.scenes.extremes import DISTANCES, NEEDLES
from tests.scenes.hard_fits import HARD_FITS


@pytest.mark.slow
def test_stability__writes_rows(tmp_path, monkeypatch):
    ladders = [NEEDLES[1.0], NEEDLES[10.0], DISTANCES[1.0], DISTANCES[10.0]]
    monkeypatch.setattr(stability, "CASES_BY_KIND", {"ladders": ladders})
    monkeypatch.setattr(stability, "HARD_FITS", HARD_FITS[2:3])
    monkeypatch.setattr(stability, "million_on_a_pixel", lambda: {"image": 1e-6, "means": 1e-5})
    stability.Options(tmp_path / "a.json").run()
    result = read_json(tmp_path / "a.json")
    assert len(result["rows"]) == 4 + 1 + 1
    assert {"machine", "versions", "commit", "date"} <= result.keys()

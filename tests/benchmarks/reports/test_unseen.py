"""Forecast of unseen views: the package's regression is the one of the committed rows."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from benchmarks.pages.results import committed
from benchmarks.reports.unseen import _conformal, held_out, out_of_capture, regression_of
from morgs_mi.capture.capture import load_capture
from morgs_mi.fit.unseen_views import REGRESSION, WIDEST

# The package has four digits.
COEFFICIENTS_REL = 1e-3


def test_regression_of__is_the_one_of_the_package():
    for ours, theirs in zip(
        astuple(regression_of(committed("unseen")["fits"])), astuple(REGRESSION), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=COEFFICIENTS_REL)


def test_out_of_capture__intervals_hold_nine_fits_in_ten():
    rows = list(out_of_capture(committed("unseen")["fits"]))
    narrow = [row for row in rows if row["width"] <= WIDEST]
    for some in (rows, narrow):
        assert sum(row["within"] for row in some) >= 0.9 * len(some)
    assert len(narrow) > 0.6 * len(rows)


def test_out_of_capture__has_not_seen_the_capture():
    rows = [row for row in committed("unseen")["fits"] if row["set"] != "fern"]
    fern = [row for row in committed("unseen")["fits"] if row["set"] == "fern"]
    spoiled = [{**row, "held_out": [0.0]} for row in fern]
    forecasts = [
        [row["forecast"] for row in out_of_capture([*rows, *fits]) if row["set"] == "fern"]
        for fits in (fern, spoiled)
    ]
    assert forecasts[0] == forecasts[1]


@pytest.mark.parametrize(
    ("captures", "error"),
    [
        ([[0.1 * k] for k in range(1, 20)], 1.8),
        ([[0.0, 0.1 * k] for k in range(1, 20)], 1.7),
        ([[1.0]] * 8, np.inf),
    ],
)
def test_conformal__is_a_rank_of_captures(captures: list[list[float]], error: float):
    assert _conformal([np.array(errors) for errors in captures]) == pytest.approx(error)


@pytest.mark.slow
def test_held_out__spreads_the_training_views_over_the_rig(clip):
    capture = load_capture(clip, test_view=None)
    count = len(capture.cameras)
    assert held_out(capture, (0.8,)) == [[view] for view in range(count)], "each of a few in turn"

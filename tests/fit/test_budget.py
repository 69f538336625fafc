"""The number of steps of the first frame within a time budget, on a clock that the test advances."""

from __future__ import annotations

import pytest

from morgs_mi.fit import budget
from morgs_mi.fit.budget import steps_within
from morgs_mi.fit.fit_config import FitConfig
from tests.scenes.ball import problem


@pytest.fixture
def steps(monkeypatch):
    """A function that returns the steps within a time, if the first ones take 0.01 s each and later ones 0.015 s."""
    now = [0.0]

    def fit(problem, config, *_):
        now[0] += 0.01 * config.first_frame_steps

    monkeypatch.setattr(budget.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(budget, "fit_first_frame", fit)
    return lambda seconds, trials=0: steps_within(seconds, problem([]), FitConfig(), trials, 0)


def test_steps_within__fill_the_time_that_the_measurement_leaves(steps):
    assert steps(15.4) == pytest.approx(1000, abs=1)  # 0.4 s were measured
    assert steps(30.4) == pytest.approx(2000, abs=1)


def test_steps_within__leave_time_for_the_trials(steps):
    assert steps(45.4, trials=2.0) == pytest.approx(1000, abs=1)
    assert steps(27.4, trials=0.8) == pytest.approx(1000, abs=1)


def test_steps_within__are_a_hundred_at_least(steps):
    assert steps(0.1) == 100

"""The steps and Gaussians of the first frame within a time budget, on a clock that the test advances."""

from __future__ import annotations

import pytest

from morgs_mi import RenderConfig
from morgs_mi.fit import budget
from morgs_mi.fit.budget import within_seconds
from morgs_mi.fit.config import CrossValidationConfig, DensityConfig, FitConfig


@pytest.fixture
def settings(monkeypatch):
    """A function that returns the settings within a time, if a step takes 0.01 s, and 0.015 s with growth."""
    now = [0.0]

    def fit(gaussians, cameras, targets, extent, config, *_):
        now[0] += 0.01 * config.first_frame_steps

    monkeypatch.setattr(budget.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(budget, "fit_first_frame", fit)
    return lambda seconds, views=4, **given: within_seconds(
        seconds, None, [None] * views, [None] * views, 1.0, FitConfig(**given), RenderConfig(), [0]
    )


@pytest.fixture
def steps(settings):
    """A function that returns the number of steps within a time."""
    return lambda *args, **given: settings(*args, **given).first_frame_steps


def test_within_seconds__fills_the_time_that_the_measurement_leaves(steps):
    assert steps(15.4, dropping=0.0) == pytest.approx(1000, abs=1)  # 0.4 s were measured
    assert steps(30.4, dropping=0.0) == pytest.approx(2000, abs=1)


def test_within_seconds__leaves_time_for_the_trials(steps):
    trials = CrossValidationConfig(candidates=(0.0, 0.2, 0.3, 0.4), steps=0.5, min_views=4)
    assert steps(60.4, cross_validation=trials) == pytest.approx(1000, abs=1)
    assert steps(45.4, views=8, cross_validation=trials) == pytest.approx(1000, abs=1)
    assert steps(30.4, views=3, cross_validation=trials) == pytest.approx(1000, abs=1)
    assert steps(30.4, views=1, cross_validation=trials) == pytest.approx(2000, abs=1)
    assert steps(30.4, dropping=0.2, cross_validation=trials) == pytest.approx(2000, abs=1)


def test_within_seconds__are_a_hundred_steps_at_least(steps):
    assert steps(0.1) == 100


def test_within_seconds__takes_fewer_gaussians_where_steps_are_few(settings):
    found = [settings(0.4 + seconds, num_gaussians=4000, dropping=0.0) for seconds in (6.0, 2.25, 1.5, 0.9)]
    assert [config.num_gaussians for config in found] == [4000, 3000, 2000, 2000]
    # Without growth all steps take 0.01 s.
    assert [config.first_frame_steps for config in found] == pytest.approx([400, 180, 150, 100], abs=1)


def test_within_seconds__keeps_the_gaussians_without_density_control(settings):
    density = DensityConfig(rounds=0)
    assert settings(1.9, num_gaussians=4000, dropping=0.0, density=density).num_gaussians == 4000

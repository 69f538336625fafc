"""The plan of the first frame, on a clock that the test advances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import RenderConfig
from morgs_mi.fit import budget
from morgs_mi.fit.budget import Plan, plan_first_frame
from morgs_mi.fit.fit_config import DensityConfig, DetailConfig, FitConfig
from morgs_mi.fit.view import View
from tests.scenes.ball import bytes_of, images_of, opaque_ball, views

NO_POINTS = np.zeros((0, 3)), np.zeros((0, 3))
PIXELS = 64 * 48
# Images of the ball ask for more Gaussians than the most.
DETAIL = DetailConfig(per_detail=100.0, least_gaussians=5_000, most_gaussians=50_000)
CONFIG = FitConfig(sh_degree=0, detail=DETAIL, dropping=0.0, density=DensityConfig(rounds=0))


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch):
    """A function that plans for a time, if a step takes 1e-6 s per Gaussian and 0.3e-6 s per pixel."""
    now = [0.0]

    def fit(problem, config, _, progress):
        for step in range(config.first_frame_steps):
            # The first steps compile kernels, and another program delays a later one.
            delay = 0.5 if step in (0, 12) else 0.0
            now[0] += delay + 1e-6 * (len(problem.start) + 0.3 * budget._pixels(problem))
            progress(step, config.first_frame_steps)

    monkeypatch.setattr(budget, "_clock", lambda: now[0])
    monkeypatch.setattr(budget, "fit_first_frame", fit)
    given = [View(*view) for view in zip(views(), bytes_of(images_of(opaque_ball())), strict=True)]

    def planned(seconds: float, config: FitConfig = CONFIG, render: RenderConfig | None = None) -> Plan:
        config = replace(config, first_frame_seconds=seconds)
        return plan_first_frame(given, NO_POINTS, config, render or RenderConfig(), 0)

    return planned


def numbers(plan: Plan) -> tuple[int, int]:
    return plan.config.planned_gaussians, plan.config.planned_steps


def test_plan_first_frame__follows_the_images_where_the_time_does_not_limit_it(plan):
    assert numbers(plan(1000)) == numbers(plan(2000)) == (50_000, 2000)
    assert plan(1000).seconds == pytest.approx(2000e-6 * (50_000 + 0.3 * PIXELS))


def test_plan_first_frame__has_fewer_gaussians_and_steps_in_less_time(plan):
    for seconds, expected in ((60, (37_000, 1500)), (30, (22_000, 1200))):  # part of which the measurement takes
        found = plan(seconds)
        gaussians, steps = numbers(found)
        assert (gaussians, steps) == pytest.approx(expected, rel=0.03)
        assert steps == max(1200, round(gaussians / 25))
        assert 0.85 * seconds < found.seconds <= seconds
    assert numbers(plan(1e-3)) == (6_250, 100), "an eighth"


def test_plan_first_frame__changes_no_number_that_is_given(plan):
    gaussians, steps = numbers(plan(10, replace(CONFIG, num_gaussians=20_000)))
    assert gaussians == 20_000
    assert steps < 1200
    gaussians, steps = numbers(plan(10, replace(CONFIG, first_frame_steps=400)))
    assert gaussians < 50_000
    assert steps == 400
    both = replace(CONFIG, num_gaussians=20_000, first_frame_steps=400)
    assert plan(1e-3, both) == Plan(replace(both, first_frame_seconds=1e-3))


def test_plan_first_frame__takes_a_reference_machine_for_reproducible_fits(plan, monkeypatch):
    monkeypatch.setattr(budget, "_measured", lambda *_: pytest.fail("the machine was timed"))
    assert plan(1.0, render=RenderConfig(reproducible=True)) == plan(1.0, render=RenderConfig(reproducible=True))


def test_Plan__announces_its_time():
    assert Plan(CONFIG).stage == "First frame"
    assert Plan(CONFIG, 118.4).stage == "First frame, about 118 s"

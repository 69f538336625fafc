"""The plan of the first frame, by the factors of a reference machine."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.core.view import View
from morgs_mi.fit import budget, fit_config
from morgs_mi.fit.budget import plan_first_frame
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from tests.scenes.ball import bytes_of, images_of, opaque_ball, views

PIXELS = 64 * 48
CONFIG = FitConfig(sh_degree=0, dropout=0.0, density=DensityConfig(rounds=0))


@pytest.fixture(autouse=True)
def limits(monkeypatch):
    """Let images of the ball ask for more Gaussians than the most."""
    monkeypatch.setattr(budget, "PER_DETAIL", 100.0)
    monkeypatch.setattr(budget, "LEAST_GAUSSIANS", 5_000)
    for module in (budget, fit_config):
        monkeypatch.setattr(module, "MOST_GAUSSIANS", 50_000)


def planned(seconds, config=CONFIG):
    views_of_ball = [
        View(*view) for view in zip(views(), bytes_of(images_of(opaque_ball())), strict=True)
    ]
    return plan_first_frame(
        views_of_ball, np.zeros((0, 3)), replace(config, first_frame_seconds=seconds)
    )


def numbers(plan):
    return plan[0].planned_gaussians, plan[0].planned_steps


def test_plan_first_frame__follows_the_images_where_the_time_does_not_limit_it():
    assert numbers(planned(1000)) == numbers(planned(2000)) == (50_000, 2000)
    assert planned(1000)[1] == pytest.approx(2000 * (2.2e-7 * 50_000 + 0.5e-7 * PIXELS))


def test_plan_first_frame__has_fewer_gaussians_and_steps_in_less_time():
    for seconds, expected in ((14, (39_300, 1570)), (7, (25_900, 1200))):
        plan = planned(seconds)
        gaussians, steps = numbers(plan)
        assert (gaussians, steps) == pytest.approx(expected, rel=0.01)
        assert steps == max(1200, round(gaussians / 25))
        assert 0.99 * seconds < plan[1] <= seconds
    assert numbers(planned(1e-3)) == (6_250, 100), "an eighth"


def test_plan_first_frame__takes_more_time_at_the_size_of_the_last_steps():
    """Up to the last round of density control, images are half as large, Gaussians fewer."""
    rounds = planned(1000, replace(CONFIG, density=DensityConfig(rounds=6)))[1]
    assert 0.8 * planned(1000)[1] < rounds < planned(1000)[1]


def test_plan_first_frame__changes_no_number_that_is_given():
    gaussians, steps = numbers(planned(2, replace(CONFIG, num_gaussians=20_000)))
    assert gaussians == 20_000
    assert steps < 1200
    gaussians, steps = numbers(planned(2, replace(CONFIG, first_frame_steps=400)))
    assert gaussians < 50_000
    assert steps == 400
    both = replace(CONFIG, num_gaussians=20_000, first_frame_steps=400)
    assert planned(1e-3, both) == (replace(both, first_frame_seconds=1e-3), None)

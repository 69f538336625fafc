"""A later frame: births and survivors, their order, and the parts of the motion."""

from dataclasses import replace

import drjit as dr
import numpy as np

from morgs_mi import RenderConfig
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.method import objective
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.method_registry import Registry
from morgs_mi.method.motion import initial_motion
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.objective import ObjectiveConfig, loss_term
from tests.scenes.ball import images_of, opaque_ball, views
from tests.scenes.views import observed

RENDER = RenderConfig()
EXTENT = 3.0
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)


def fit(previous, images, config, motion=PLAIN):
    active = full_active_set(previous, dict(enumerate(views())), RENDER)
    problem = FrameProblem(previous, active, observed(active.views, images), None, EXTENT)
    return fit_later_frame(problem, config, motion, np.random.default_rng(0))


def test_fit_later_frame__adds_none_when_no_step_is_left_to_fit_them():
    truth = opaque_ball()
    config = FitConfig(sh_degree=0, epochs=1, density=DensityConfig(min_error=0))
    fitted = fit(truth.select(np.arange(200)), images_of(truth), config)
    assert np.array_equal(fitted.source, np.arange(200))


def test_fit_later_frame__terms_compare_with_the_previous_frame(monkeypatch):
    """With births, there are more Gaussians after the round of density control than before it."""
    monkeypatch.setattr(
        objective, "LOSS_TERMS", Registry("ObjectiveConfig()", "terms", ObjectiveConfig)
    )
    compared = []

    @loss_term("still")
    def still_loss(prediction, observations, config):
        previous = prediction.previous
        if not any(previous is other for other in compared):
            compared.append(previous)
        return dr.mean(dr.abs(prediction.gaussians.means - previous.means), axis=None)

    truth = opaque_ball()
    start = truth.select(np.flatnonzero(truth.numpy()["means"][:, 0] < 0.3))
    density = DensityConfig(births=0.3, min_error=0)
    config = FitConfig(sh_degree=0, epochs=4, density=density)
    free, held = (
        fit(start, images_of(truth), replace(config, objective=ObjectiveConfig(terms=terms)))
        for terms in ((), ("still:100",))
    )
    old_means, new_means = (np.asarray(previous.means) for previous in compared)
    assert np.array_equal(old_means, start.means)
    assert len(new_means) == len(held.gaussians) > len(old_means)
    survivors = held.source[held.source >= 0]
    assert np.array_equal(new_means[: len(survivors)], old_means[survivors])
    assert held.losses.keys() == {"recon", "still"}
    displacement = np.asarray(held.gaussians.means)[: len(survivors)] - old_means[survivors]
    assert np.allclose(np.asarray(held.gaussians.motion)[: len(survivors)], displacement, atol=1e-6)
    moves, free_moves = (
        np.abs(np.asarray(result.gaussians.motion)[result.source >= 0]).mean()
        for result in (held, free)
    )
    assert moves < 0.5 * free_moves


def test_initial_motion__continues_with_constant_velocity():
    previous_gaussians = replace(opaque_ball(), motion=np.full((400, 3), 0.1))
    rng = np.random.default_rng(0)
    active = full_active_set(previous_gaussians, dict(enumerate(views())), RENDER)
    active_views = observed(active.views, images_of(opaque_ball()))
    assert initial_motion(previous_gaussians, active, active_views, PLAIN, rng) is None
    constant = replace(PLAIN, constant_velocity=True)
    start = initial_motion(previous_gaussians, active, active_views, constant, rng)
    assert np.array_equal(start.displacement, np.full((400, 3), 0.1, np.float32))

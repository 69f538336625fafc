"""A later frame: births and survivors, their order, and the parts of the motion."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import Gaussians, RenderConfig
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.loop.stream_config import StreamConfig, apply_preset
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.motion import initial_motion
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.objective import ObjectiveConfig
from morgs_mi.method.ssim import Target
from tests.scenes.ball import images_of, mean_psnr, opaque_ball, views

RENDER = RenderConfig()
EXTENT = 3.0
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)


def fit(previous, images, config, motion=PLAIN):
    active = full_active_set(previous, dict(enumerate(views())), RENDER)
    targets = {view: Target(image) for view, image in enumerate(images)}
    problem = FrameProblem(previous, active, targets, {}, None, EXTENT)
    return fit_later_frame(problem, config, motion, np.random.default_rng(0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "motion", [PLAIN, MotionConfig(learn_motion=False)], ids=["plain", "gated"]
)
def test_fit_later_frame__reports_births_and_survivors(motion):
    """Half of the ball is new: births help, survivors stay in order, births come last."""
    truth = opaque_ball()
    images = images_of(truth)
    start = truth.select(np.flatnonzero(truth.numpy()["means"][:, 0] < 0.3))
    results = {}
    for births in (0.0, 0.3):
        density = DensityConfig(later_frames=True, births=births, min_error=0)
        fitted = fit(start, images, FitConfig(sh_degree=0, epochs=24, density=density), motion)
        gaussians = fitted.gaussians
        source = fitted.source
        losses = fitted.losses
        survivors = source[source >= 0]
        assert len(source) == len(gaussians)
        assert np.array_equal(survivors, np.unique(survivors))
        assert (source[len(survivors) :] == -1).all()
        assert (source == -1).sum() == round(births * len(start))
        assert np.isfinite(losses["recon"])
        raw = gaussians.numpy()
        moves = raw["means"][: len(survivors)] - start.numpy()["means"][survivors]
        assert raw["motion"][: len(survivors)] == pytest.approx(moves, abs=1e-6), (
            "the whole displacement"
        )
        assert raw["offset"].any() == motion.learn_offset
        results[births] = mean_psnr(gaussians, images)
    assert results[0.3] > results[0.0] + 0.05  # dB; runs differ by 1e-5


def test_fit_later_frame__keeps_all_without_density_control():
    truth = opaque_ball()
    fitted = fit(
        truth,
        images_of(truth),
        FitConfig(sh_degree=0, epochs=1, density=DensityConfig(later_frames=False)),
    )
    assert isinstance(fitted.gaussians, Gaussians)
    assert np.array_equal(fitted.source, np.arange(400))


def test_fit_later_frame__adds_none_when_no_step_is_left_to_fit_them():
    truth = opaque_ball()
    config = FitConfig(sh_degree=0, epochs=1, density=DensityConfig(min_error=0))
    fitted = fit(truth.select(np.arange(200)), images_of(truth), config)
    assert np.array_equal(fitted.source, np.arange(200))


def shifted(shift):
    """Return a ball, the ball after a shift, and the shift."""
    ball = opaque_ball()
    by = np.array(shift, np.float32)
    return ball, replace(ball, means=np.asarray(ball.means) + by), by


@pytest.mark.slow
def test_fit_later_frame__rigid_neighbours_move_alike():
    start, truth, shift = shifted((0.06, -0.03, 0.02))
    usual = FitConfig(sh_degree=0, epochs=8, density=DensityConfig(later_frames=False))
    preset = apply_preset(StreamConfig(fit=usual), "rigidity").fit
    results = [fit(start, images_of(truth), config) for config in (usual, preset)]
    free, rigid = (
        np.linalg.norm(np.asarray(r.gaussians.motion) - shift, axis=1).mean() for r in results
    )
    assert rigid < 0.5 * free
    assert results[1].losses.keys() == {"recon", "rigid", "rotation", "isometry"}
    for name in ("log_scales", "logit_opacities", "sh_coeffs"):
        assert np.array_equal(getattr(results[1].gaussians, name), getattr(start, name)), (
            "the preset moves alone"
        )


def test_fit_later_frame__compares_the_neighbours_of_births_with_their_parents():
    """With births, there are more Gaussians after the round of density control than before it."""
    truth = opaque_ball()
    start = truth.select(np.flatnonzero(truth.numpy()["means"][:, 0] < 0.3))
    config = FitConfig(
        sh_degree=0,
        epochs=4,
        objective=ObjectiveConfig(rigid_weight=1.0),
        density=DensityConfig(births=0.3, min_error=0),
    )
    result = fit(start, images_of(truth), config)
    assert len(result.gaussians) > len(start)
    assert np.isfinite(result.losses["rigid"])
    alone = fit(truth.select(np.array([3])), images_of(truth), config)
    assert alone.losses.keys() == {"recon"}


def test_initial_motion__continues_with_constant_velocity():
    previous_gaussians = replace(opaque_ball(), motion=np.full((400, 3), 0.1))
    rng = np.random.default_rng(0)
    active = full_active_set(previous_gaussians, dict(enumerate(views())), RENDER)
    assert initial_motion(previous_gaussians, active, {}, {}, PLAIN, rng) is None
    start = initial_motion(
        previous_gaussians, active, {}, {}, replace(PLAIN, constant_velocity=True), rng
    )
    assert np.array_equal(start.displacement, np.full((400, 3), 0.1, np.float32))

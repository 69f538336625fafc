"""A later frame: births and survivors, their order, and the parts of the motion."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi import Gaussians, RenderConfig
from morgs_mi.fit.config import DensityConfig, FitConfig
from morgs_mi.fit.later_frame import FrameProblem, LaterFrame, fit_later_frame
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.config import MotionConfig
from tests.scenes.ball import images_of, mean_psnr, opaque_ball, views

RENDER, EXTENT = RenderConfig(), 3.0
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)


def fit(before: Gaussians, images: list[np.ndarray], config: FitConfig, motion: MotionConfig = PLAIN) -> LaterFrame:
    active = full_active_set(before, dict(enumerate(views())), RENDER)
    targets = {view: Target(image) for view, image in enumerate(images)}
    problem = FrameProblem(before, active, targets, {}, None, EXTENT)
    return fit_later_frame(problem, config, motion, np.random.default_rng(0))


@pytest.mark.parametrize("motion", [PLAIN, MotionConfig(learn_motion=False)], ids=["plain", "gated"])
def test_fit_later_frame__reports_births_and_survivors(motion):
    """Half of the ball is new: births help, survivors stay in order, births come last."""
    truth = opaque_ball()
    images = images_of(truth)
    before = truth.select(np.flatnonzero(truth.numpy()["means"][:, 0] < 0.3))
    results = {}
    for births in (0.0, 0.3):
        density = DensityConfig(later_frames=True, births=births, min_error=0)
        fitted = fit(before, images, FitConfig(sh_degree=0, epochs=24, density=density), motion)
        found, source, losses = fitted.gaussians, fitted.source, fitted.losses
        survivors = source[source >= 0]
        assert len(source) == len(found)
        assert np.array_equal(survivors, np.unique(survivors))
        assert (source[len(survivors) :] == -1).all()
        assert (source == -1).sum() == round(births * len(before))
        assert np.isfinite(losses["recon"])
        raw = found.numpy()
        moved = raw["means"][: len(survivors)] - before.numpy()["means"][survivors]
        parts = (raw["motion"] + raw["offset"])[: len(survivors)]
        assert parts == pytest.approx(moved, abs=1e-6), "motion and offset add up to the displacement"
        assert raw["offset"].any() == motion.learn_offset
        results[births] = mean_psnr(found, images)
    assert results[0.3] > results[0.0] + 0.05  # dB; runs differ by 1e-5


def test_fit_later_frame__keeps_all_without_density_control():
    truth = opaque_ball()
    fitted = fit(truth, images_of(truth), FitConfig(sh_degree=0, epochs=1, density=DensityConfig(later_frames=False)))
    assert isinstance(fitted.gaussians, Gaussians)
    assert np.array_equal(fitted.source, np.arange(400))


def test_fit_later_frame__adds_none_when_no_step_is_left_to_fit_them():
    truth = opaque_ball()
    config = FitConfig(sh_degree=0, epochs=1, density=DensityConfig(min_error=0))
    fitted = fit(truth.select(np.arange(200)), images_of(truth), config)
    assert np.array_equal(fitted.source, np.arange(200))

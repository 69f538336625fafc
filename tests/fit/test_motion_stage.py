"""The first stage of a later frame: shared motion is found, and the residual starts from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import Gaussians, RenderConfig
from morgs_mi.fit.config import DensityConfig, FitConfig
from morgs_mi.fit.later_frame import FrameProblem, LaterFrame, fit_later_frame
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.anchors import AnchorConfig
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.hicom import HicomConfig
from morgs_mi.method.motion_grid import GridConfig
from morgs_mi.method.motion_start import MotionStart
from morgs_mi.method.transformation_cache import CacheConfig
from tests.scenes.ball import images_of, mean_psnr, opaque_ball, views

RENDER, EXTENT, SHIFT = RenderConfig(reproducible=True), 3.0, np.array([0.06, -0.03, 0.02], np.float32)
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)
# Settings that suit a ball of 400 Gaussians.
MODELS = {
    "hicom": replace(PLAIN, model="hicom", hicom=HicomConfig(cells=(1.0, 0.3), translation_rate=2e-3)),
    "cache": replace(PLAIN, model="cache", cache=CacheConfig(levels=2, coarsest=1.0)),
    "grid": replace(PLAIN, model="grid", grid=GridConfig(cells=(1.0, 0.3), translation_rate=2e-3)),
    "anchors": replace(PLAIN, model="anchors", anchors=AnchorConfig(levels=2, gaussians=40, translation_rate=2e-3)),
}
FIT = FitConfig(sh_degree=0, epochs=8, density=DensityConfig(later_frames=False))


def fit(
    motion: MotionConfig, start: MotionStart | None = None, config: FitConfig = FIT
) -> tuple[LaterFrame, Gaussians]:
    """Fit a ball that has moved by `SHIFT`; return the result and the truth."""
    before = opaque_ball()
    truth = replace(before, means=np.asarray(before.means) + SHIFT)
    active = full_active_set(before, dict(enumerate(views())), RENDER)
    targets = {view: Target(image) for view, image in enumerate(images_of(truth))}
    problem = FrameProblem(before, active, targets, {}, start, EXTENT)
    return fit_later_frame(problem, config, motion, np.random.default_rng(0)), truth


def motion_error(found: LaterFrame) -> float:
    return float(np.linalg.norm(np.asarray(found.gaussians.motion) - SHIFT, axis=1).mean())


@pytest.mark.parametrize("motion", MODELS.values(), ids=MODELS)
def test_fit_later_frame__finds_the_motion_that_gaussians_share(motion):
    """With as many steps, the motion of a rigid body is nearer to the truth than that of free Gaussians."""
    (free, truth), (shared, _) = fit(PLAIN), fit(motion)
    assert motion_error(shared) < 0.7 * motion_error(free)
    assert mean_psnr(shared.gaussians, images_of(truth)) > mean_psnr(free.gaussians, images_of(truth))
    assert shared.epochs == free.epochs == FIT.epochs


@pytest.mark.parametrize("motion", MODELS.values(), ids=MODELS)
def test_fit_later_frame__continues_from_a_start(motion):
    """The steps after the start still move Gaussians that are seen badly, but the start is not lost."""
    exact = MotionStart(np.tile(SHIFT, (400, 1)), np.zeros(400, np.float32))
    (begun, _), (found, _) = (fit(motion, start, replace(FIT, epochs=2)) for start in (exact, None))
    assert motion_error(begun) < 0.5 * motion_error(found)


@pytest.mark.parametrize("motion", MODELS.values(), ids=MODELS)
def test_fit_later_frame__repeats_a_motion_model_to_the_bit(motion):
    one, other = (fit(motion, config=replace(FIT, epochs=2))[0].gaussians for _ in range(2))
    assert all(np.array_equal(value, other.numpy()[name]) for name, value in one.numpy().items())


def test_fit_later_frame__fits_the_model_alone_in_a_single_epoch():
    found, _ = fit(replace(PLAIN, model="hicom"), config=replace(FIT, epochs=1))
    assert found.epochs == 1
    assert found.losses["recon"] > 0
    assert not np.asarray(found.gaussians.offset).any()


SETTINGS = {
    "hicom": {"cells": (0.3, 0.1), "translation_rate": 1e-3, "rotation_rate": 0.0},
    "cache": {
        "levels": 3,
        "coarsest": 0.5,
        "table": 100,
        "features": 2,
        "hidden": 8,
        "spread": 0.1,
        "displacement": 0.3,
        "rate": 1e-4,
        "table_rate": 0.0,
    },
    "grid": {
        "cells": (0.3, 0.1),
        "translation_step": 1e-2,
        "rotation_step": 0.1,
        "translation_rate": 1e-3,
        "rotation_rate": 0.0,
        "scale": 0.5,
        "scale_rate": 1.0,
        "rate_weight": 1.0,
    },
    "anchors": {
        "levels": 1,
        "gaussians": 80,
        "ratio": 2,
        "translation_step": 0.0,
        "rotation_step": 0.0,
        "translation_rate": 1e-3,
        "rotation_rate": 0.0,
    },
}


@pytest.mark.parametrize(("model", "name"), [(model, name) for model, names in SETTINGS.items() for name in names])
def test_fit_later_frame__every_setting_of_a_model_acts(model, name):
    config, usual = replace(FIT, epochs=2), MODELS[model]
    changed = replace(usual, **{model: replace(getattr(usual, model), **{name: SETTINGS[model][name]})})
    results = [fit(motion, config=config)[0].gaussians.numpy() for motion in (usual, changed)]
    assert any(not np.array_equal(value, results[1][field]) for field, value in results[0].items())


def test_fit_later_frame__shares_its_epochs_with_the_model():
    motions = [replace(PLAIN, model="hicom", model_share=share) for share in (0.25, 1.0)]
    some, all_of_it = (fit(motion, config=replace(FIT, epochs=4))[0] for motion in motions)
    assert some.epochs == all_of_it.epochs == 4
    assert np.abs(np.asarray(some.gaussians.log_scales) - np.asarray(opaque_ball().log_scales)).max() > 0
    assert np.array_equal(all_of_it.gaussians.log_scales, opaque_ball().log_scales)

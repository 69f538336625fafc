"""The first stage of a later frame: shared motion is found, and the residual starts from it."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array

from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.method.motion_model import (
    MOTION_MODELS,
    MotionModel,
    sparse_product,
)
from morgs_mi.method.motion_start import MotionStart
from tests.scenes.ball import opaque_ball, views
from tests.scenes.shifted_ball import FIT, PLAIN, SHIFT, fit_shifted, motion_error


@MOTION_MODELS.register("test-shift")
def _one_shift(argument, config):
    """Return the factory of one translation for all Gaussians, with a loss of its own."""

    def make(gaussians, extent, rng):
        everyone = csr_array(np.ones((len(gaussians), 1), np.float32))
        return MotionModel(
            {"shift": dr.zeros(mi.TensorXf, (1, 3))},
            {"shift": 2e-3 * extent},
            lambda p: (
                sparse_product(everyone, p["shift"]),
                dr.zeros(mi.TensorXf, (len(gaussians), 4)),
            ),
            lambda p: {"length": 1e-4 * dr.sum(dr.abs(p["shift"].array))},
        )

    return make


MODEL = replace(PLAIN, model="test-shift")


def fit(config=FIT, start=None, share=MODEL.model_share):
    return fit_shifted(replace(MODEL, model_share=share), start, config)


def test_fit_later_frame__continues_from_a_start():
    exact = MotionStart(np.tile(SHIFT, (400, 1)), np.zeros(400, np.float32))
    few = replace(FIT, epochs=2)
    assert motion_error(fit(few, exact)) < 0.5 * motion_error(fit(few))


def test_fit_later_frame__fits_the_model_alone_in_a_single_epoch():
    result = fit(replace(FIT, epochs=1))
    assert result.steps == len(views())
    assert result.losses["recon"] > 0
    assert result.losses["length"] > 0
    assert not np.asarray(result.gaussians.offset).any()


def test_fit_later_frame__shares_its_epochs_with_the_model():
    some, all_of_it = (fit(replace(FIT, epochs=4), share=share) for share in (0.25, 1.0))
    assert some.steps == all_of_it.steps == 4 * len(views())
    assert (
        np.abs(np.asarray(some.gaussians.log_scales) - np.asarray(opaque_ball().log_scales)).max()
        > 0
    )
    assert np.array_equal(all_of_it.gaussians.log_scales, opaque_ball().log_scales)


def test_fit_later_frame__adds_gaussians_by_the_errors_after_the_model():
    """The stage of the model has no densification scores: an epoch of the residual comes first."""
    density = DensityConfig(births=0.3, min_error=0)
    result = fit(replace(FIT, epochs=4, density=density), share=0.5)
    assert (result.source == -1).any()

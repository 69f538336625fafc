"""Random dropout of Gaussians."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi import RenderConfig
from morgs_mi.core.view import View
from morgs_mi.fit.first_frame import adapted_to_images, dropped
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import FirstFrameProblem
from tests.scenes.ball import bytes_of, images_of, opaque_ball, problem
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.derivatives import backward, gradient
from tests.scenes.gaussians import isotropic

COUNT = 4000
GREY = [0.2 + 0.6 * image for image in images_of(opaque_ball())]
GAUSSIANS = isotropic(np.zeros((COUNT, 3)), 0.1, 0.3, np.zeros((COUNT, 1, 3)))


@pytest.mark.parametrize("probability", [0.2, 0.5])
def test_dropped__keeps_the_expected_opacity(probability):
    opacities = np.asarray(dropped(GAUSSIANS, probability, np.random.default_rng(0)).opacities)
    mask = opacities > 1e-6
    assert mask.mean() == pytest.approx(1 - probability, abs=0.03)
    assert_allclose(opacities[mask], 0.3 / (1 - probability), rtol=1e-5)


def test_dropped__has_no_opacity_above_one():
    opaque = isotropic(np.zeros((50, 3)), 0.1, 0.95, np.zeros((50, 1, 3)))
    opacities = np.asarray(dropped(opaque, 0.4, np.random.default_rng(0)).opacities)
    assert np.isfinite(opacities).all()
    assert 0.95 < opacities.max() < 1


def test_dropped__passes_gradients_to_the_kept_alone():
    logits = mi.TensorXf(np.zeros(20, np.float32))
    dr.enable_grad(logits)
    few = GAUSSIANS.select(np.arange(20)).with_parameters({"logit_opacities": logits})
    survivors = dropped(few, 0.5, np.random.default_rng(1))
    backward(survivors.opacities)
    mask = np.asarray(survivors.opacities) > 1e-6
    # d(2 sigmoid(l)) / dl at l = 0; the largest opacity is 0.999, where nothing is passed on.
    assert not gradient(logits)[~mask].any()
    assert mask.any()


def test_adapted_to_images__sets_a_dropout_for_few_views_that_are_noisy_or_far_apart():
    rng = np.random.default_rng(0)

    def dropout(noise, degrees, times=1):
        noisy = [255 * (image + rng.normal(0, noise, image.shape)) for image in times * GREY]
        cameras = look_at_cameras(arc(np.deg2rad(degrees) * np.arange(len(noisy)), 3.5), 40)
        images = [np.uint8(np.clip(image + 0.5, 0, 255)) for image in noisy]
        views = tuple(map(View, cameras, images))
        few = FirstFrameProblem(GAUSSIANS, views, np.zeros((0, 3)), 3.0, RenderConfig())
        adapted = adapted_to_images(FitConfig(), few).dropout
        return adapted

    assert [dropout(noise, 8) for noise in (0.0, 0.008, 0.02)] == [0, 0, 0.2]
    assert [dropout(0.0, degrees) for degrees in (8, 40)] == [0, 0.2]
    assert dropout(0.02, 40, times=2) == 0


@pytest.mark.parametrize(
    ("noise", "dropout", "dssim_weight"), [(0.0, 0.0, 0.2), (0.008, 0.0, 0.2), (0.05, 0.2, 0.0)]
)
def test_adapted_to_images__follows_the_noise(noise, dropout, dssim_weight):
    config = FitConfig(sh_degree=0)
    adapted = adapted_to_images(config, problem(bytes_of(GREY, noise)))
    objective = replace(config.objective, dssim_weight=dssim_weight)
    assert adapted == replace(config, dropout=dropout, objective=objective)

    given = FitConfig(dropout=0.1, noise_aware=False)
    assert adapted_to_images(given, problem(bytes_of(GREY, noise))) == given

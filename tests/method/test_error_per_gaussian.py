"""Densification scores from the adjoint of a step, against back-projections."""

import cv2
import drjit as dr
import numpy as np
import pytest

from morgs_mi import RenderConfig
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.method.error_per_gaussian import ErrorPerGaussian, densification_scores
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet
from tests.scenes.views import make_active_view

N = 300


def sheet(rng, n=N, depth=0.6):
    colors = rng.uniform(-1.5, 1.5, (n, 1, 3))
    return isotropic(random_sheet(rng, n, 1.2, depth), 0.06, 0.8, colors)


@pytest.fixture(scope="module")
def scene():
    """A wall; the whole of one view and a part of another one, whose target is masked."""
    rng = np.random.default_rng(0)
    wall = sheet(rng)
    cameras = look_at_cameras([(x, 0.3, -3) for x in (-0.8, 0.8)], 45, 80, 60)
    part = np.zeros((60, 80), bool)
    part[20:50, 10:60] = True
    static = sheet(rng, 40, 0.3)
    views = [
        ActiveView(cameras[0]),
        make_active_view(cameras[1], Region.of(part), static, ("color",), RenderConfig()),
    ]
    images = [cv2.GaussianBlur(rng.random((60, 80, 3), np.float32), (0, 0), 2) for _ in views]
    targets = [Target(images[0]), Target(images[1], rng.random((60, 80)) > 0.3)]
    return wall, list(map(ObservedView.of, views, targets))


def scores_of(wall, views):
    """Return the scores of one step in each view, and the gradient of the colours from its term."""
    scores = ErrorPerGaussian(N)
    for view in views:
        dr.enable_grad(wall.sh_coeffs)
        image = render_view(wall, view, features=scores.features(), detach_weights=("features",))
        scores.observe(image, view.target, view.region)
        term = scores.term
        assert np.asarray(term).item() == 0
        dr.backward(term)
        scores.collect()
    return np.asarray(scores.scores), np.asarray(dr.grad(wall.sh_coeffs))


def test_error_per_gaussian__is_what_back_projection_gives(scene, monkeypatch):
    monkeypatch.setattr("morgs_mi.method.error_per_gaussian.NOISE", 0.0)
    scores, gradient = scores_of(*scene)
    expected = densification_scores(*scene)
    assert_close(scores, expected, rtol=1e-4)
    assert not gradient.any(), "the images must not change because of the scores"


def test_error_per_gaussian__ignores_noise():
    """Of an image with noise, errors count only where something else is wrong."""
    rng = np.random.default_rng(1)
    wall = sheet(rng)
    view = ActiveView(look_at_cameras([(0, 0.3, -3)], 45, 80, 60)[0])
    image = np.asarray(render_view(wall, view).color) + rng.normal(0, 0.02, (60, 80, 3)).astype(
        np.float32
    )
    image[20:30, 30:40] += 0.5
    scores, _ = scores_of(wall, [ObservedView.of(view, Target(np.clip(image, 0, 1)))])
    pixels, _ = view.camera.project(np.asarray(wall.means))
    near = (np.abs(pixels - (35, 25)) < (12, 12)).all(axis=1)
    assert scores[~near].max() < 0.02 * scores[near].max()
    assert scores[~near].max() < DensityConfig().min_error


def test_error_per_gaussian__skips_the_first_steps():
    scores = ErrorPerGaussian(3, skip=2)
    rendered = []
    for _ in range(3):
        rendered.append(scores.features() is not None)
        scores.collect()
    assert rendered == [False, False, True]
    assert scores.term is None

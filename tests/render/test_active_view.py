"""A window draws a part of a view before what stands still, as if everything were drawn anew."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.render.active_view import ActiveView, make_active_view
from morgs_mi.render.backproject import backproject
from tests import tolerances as tol

CHANNELS = ("color", "alpha", "depth", "motion", "confidence")
N, MOVING = 120, np.arange(0, 120, 5)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, 101, 75)


@pytest.fixture(scope="module")
def everyone() -> Gaussians:
    """Of no two equal depths."""
    rng = np.random.default_rng(7)
    return Gaussians(
        rng.uniform((-1.5, -1.0, -0.5), (1.5, 1.0, 0.5), (N, 3)),
        rng.uniform(np.log(0.02), np.log(0.2), (N, 3)),
        rng.normal(size=(N, 4)),
        rng.uniform(-2, 3, N),
        rng.normal(size=(N, 4, 3)) * 0.3,
        rng.normal(size=(N, 3)) * 0.1,
        rng.normal(size=N),
    )


@pytest.fixture(scope="module")
def mask(camera: Camera) -> np.ndarray:
    y, x = np.mgrid[: camera.height, : camera.width]
    return (x - 30) ** 2 + (y - 20) ** 2 < 20**2


def opened(camera, everyone, mask) -> tuple[ActiveView, Gaussians]:
    moving = np.isin(np.arange(N), MOVING)
    return make_active_view(camera, mask, everyone.select(~moving), CHANNELS, RenderConfig()), everyone.select(moving)


def test_a_window_shows_and_teaches_what_the_whole_view_does(camera, everyone, mask):
    window, moving = opened(camera, everyone, mask)
    assert 0.1 < window.pixel_fraction < 0.4
    dr.enable_grad(moving.means, moving.sh_coeffs, everyone.means, everyone.sh_coeffs)
    part, whole = window.render(moving, CHANNELS), rasterize(everyone, camera, CHANNELS)
    for name in CHANNELS:
        assert np.array_equal(getattr(part, name), window.crop(np.asarray(getattr(whole, name)))), name
    weight = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))
    shown = window.region.paste(np.ones(window.region.shape(1)[:3]), np.zeros(mask.shape))
    dr.backward(dr.sum(part.color * mi.TensorXf(np.float32(window.crop(weight))), axis=None))
    dr.backward(dr.sum(whole.color * mi.TensorXf(np.float32(weight * shown[..., None])), axis=None))
    for name in ("means", "sh_coeffs"):
        found, expected = np.asarray(dr.grad(getattr(moving, name))), np.asarray(dr.grad(getattr(everyone, name)))
        assert np.abs(expected[MOVING]).max() > 0
        assert np.abs(found - expected[MOVING]).max() < tol.SUM_ORDER_REL * np.abs(expected).max(), name


def test_who_stands_still_takes_their_share_of_the_pixels(camera, everyone, mask):
    window, moving = opened(camera, everyone, mask)
    drawn = window.region.paste(np.ones(window.region.shape(1)[:3]), np.zeros(mask.shape))
    picture = np.float32(np.random.default_rng(1).uniform(size=(camera.height, camera.width, 2)))
    expected = backproject(everyone, camera, picture * np.float32(drawn)[..., None])[MOVING]
    found = window.backproject(moving, window.crop(picture))
    assert expected.max() > 10
    assert np.abs(found - expected).max() < tol.SUM_ORDER_REL * expected.max()


def test_nobody_stands_still(camera, everyone, mask):
    nobody = everyone.select(np.zeros(0, int))
    window = make_active_view(camera, mask, nobody, CHANNELS, RenderConfig())
    whole = rasterize(everyone, camera, ("color",)).color
    assert np.array_equal(window.render(everyone).color, window.crop(np.asarray(whole)))

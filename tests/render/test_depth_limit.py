"""`rasterize` with a depth limit per pixel: closed forms, the reference, derivatives, bad input."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import erf

from morgs_mi import RenderConfig, rasterize
from morgs_mi.render.active_view import ActiveView, StaticSplats
from morgs_mi.render.projection import project
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests import reference
from tests import tolerances as tol
from tests.reference import rasterize_view
from tests.scenes.derivatives import (
    assert_forward_agrees_with_reference,
    assert_gradients_of_reference,
    random_weight,
)
from tests.scenes.gaussians import CHANNELS, to_gaussians


@pytest.fixture(scope="module")
def limit(scene):
    """A tilted plane through the cloud, with a part at infinity and one in front of everything."""
    _, camera = scene
    x, y = np.meshgrid(np.linspace(-1, 1, camera.width), np.linspace(-1, 1, camera.height))
    limit = np.float32(3.0 + 0.5 * x - 0.3 * y)
    limit[:3] = np.inf
    limit[-2:] = 0.0
    return limit


@pytest.mark.parametrize("channel", ["color", "alpha", "depth", "motion", "confidence"])
def test_depth_limit__image_agrees_with_the_reference(scene, limit, channel):
    raw, camera = scene
    expected = rasterize_view(raw, camera, depth_limit=limit)
    solid = expected["alpha"] > 0.2 if channel in ("depth", "motion") else True
    image = render_view(to_gaussians(raw), ActiveView(camera), (channel,), depth_limit=limit)[
        channel
    ]
    assert_close(image, expected[channel], atol=5 * tol.IMAGE_ABS, where=solid)


@pytest.mark.slow
@pytest.mark.parametrize("channel", CHANNELS)
def test_depth_limit__backward_agrees_with_the_reference(scene, limit, channel):
    raw, camera = scene
    solid = rasterize_view(raw, camera, depth_limit=limit)["alpha"] > 0.1
    weight = random_weight(camera, channel, 1) * solid
    rtol = 5 * tol.GRADIENT_REL
    assert_gradients_of_reference(raw, camera, channel, weight, rtol=rtol, depth_limit=limit)


@pytest.mark.slow
def test_depth_limit__forward_mode_agrees_with_the_reference(scene, limit):
    assert_forward_agrees_with_reference(
        *scene, ("color", "alpha"), 5 * tol.GRADIENT_REL, depth_limit=limit
    )


def test_depth_limit__draws_nothing_where_the_gaussian_is_too_faint(scene):
    raw, camera = scene
    faint = to_gaussians({**raw, "log_scales": np.full_like(raw["log_scales"], np.log(0.1))})
    limit = np.full((camera.height, camera.width), np.linalg.norm(camera.position))
    uncut = np.array(rasterize(faint, camera, ("alpha",)).alpha)
    alpha = np.array(render_view(faint, ActiveView(camera), ("alpha",), depth_limit=limit).alpha)
    assert (uncut == 0).any()
    assert not alpha[uncut == 0].any()


def test_depth_limit__on_a_region_equals_the_full_image(scene, limit):
    raw, camera = scene
    mask = np.zeros((camera.height, camera.width), bool)
    mask[5:9, 6:17] = True
    region = Region.of(mask)
    full, part = (
        render_view(to_gaussians(raw), view, depth_limit=limit).color
        for view in (ActiveView(camera), ActiveView(camera, region=region))
    )
    assert_close(part, region.crop(np.asarray(full)), atol=tol.IMAGE_ABS)


def test_reference__distribution_function_is_the_normal_one():
    q = np.linspace(-5, 5, 101)
    assert_allclose(reference.normal_cdf(q), 0.5 * (1 + erf(q / np.sqrt(2))), atol=2e-4)


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        (np.ones((18, 22)), r"must be one depth per pixel, \[18, 21\], got \[18, 22\]"),
        (np.full((18, 21), np.nan), r"one depth per pixel, \[18, 21\], got NaN"),
    ],
)
def test_depth_limit__refuses_bad_input(scene, limit, message):
    raw, camera = scene
    with pytest.raises(ValueError, match=message):
        render_view(to_gaussians(raw), ActiveView(camera), depth_limit=limit)


def test_depth_limit__refuses_gradients_and_static_splats(scene):
    raw, camera = scene
    limit = mi.TensorXf(np.ones((camera.height, camera.width), np.float32))
    static = project(to_gaussians(raw), camera, ("color",), RenderConfig())
    view = ActiveView(camera, static_splats=StaticSplats(static, 0, len(static)))
    with pytest.raises(
        ValueError, match="`depth_limit` must be None where `static_splats` are given"
    ):
        render_view(to_gaussians(raw), view, depth_limit=limit)
    dr.enable_grad(limit)
    with pytest.raises(ValueError, match="gets no gradient"):
        render_view(to_gaussians(raw), ActiveView(camera), depth_limit=limit)

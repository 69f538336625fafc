"""`rasterize` with a depth limit per pixel: closed forms, the reference, derivatives, bad input."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import erf

from morgs_mi import Gaussians, RenderConfig, rasterize
from morgs_mi.render.active_view import ActiveView, StaticSplats
from morgs_mi.render.projection import project
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests import reference
from tests import tolerances as tol
from tests.reference import rasterize_view
from tests.scenes.cameras import look_at_cameras
from tests.scenes.derivatives import (
    assert_forward_agrees_with_reference,
    assert_gradients_of_reference,
    random_weight,
)
from tests.scenes.gaussians import CHANNELS, isotropic, to_gaussians


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


@pytest.mark.slow
def test_depth_limit__at_infinity_changes_no_bit(scene):
    raw, camera = scene
    limit = np.full((camera.height, camera.width), np.inf)
    image = render_view(to_gaussians(raw), ActiveView(camera), CHANNELS, depth_limit=limit)
    expected = rasterize(to_gaussians(raw), camera, CHANNELS)
    for name in CHANNELS:
        assert_array_equal(image[name], expected[name])


def test_depth_limit__draws_nothing_where_the_gaussian_is_too_faint(scene):
    raw, camera = scene
    faint = to_gaussians({**raw, "log_scales": np.full_like(raw["log_scales"], np.log(0.1))})
    limit = np.full((camera.height, camera.width), np.linalg.norm(camera.position))
    uncut = np.array(rasterize(faint, camera, ("alpha",)).alpha)
    alpha = np.array(render_view(faint, ActiveView(camera), ("alpha",), depth_limit=limit).alpha)
    assert (uncut == 0).any()
    assert not alpha[uncut == 0].any()


def test_depth_limit__inside_equals_the_list_cut_at_that_depth():
    """Between two layers of small Gaussians, the image shows the nearer layer."""
    (camera,) = look_at_cameras([(0, 0, -4)], 45)
    rng = np.random.default_rng(3)
    means = np.stack([*rng.uniform(-1, 1, (2, 60)), np.repeat([-0.5, 0.5], 30)], axis=1)
    colors = rng.uniform(-1, 1, (60, 1, 3))
    cloud = isotropic(means, 0.05, 0.7, colors)
    near = isotropic(means[:30], 0.05, 0.7, colors[:30])
    limit = np.full((camera.height, camera.width), 4.0)
    image = render_view(cloud, ActiveView(camera), ("color", "alpha"), depth_limit=limit)
    expected = rasterize(near, camera)
    for name in ("color", "alpha"):
        assert_close(image[name], expected[name], atol=tol.IMAGE_ABS, name=name)


def _large_gaussian():
    (camera,) = look_at_cameras([(0, 0, -40)], 3)
    quat = np.array([[0.9, 0.2, -0.3, 0.15]])
    return Gaussians.from_activated(
        np.zeros((1, 3)), [[0.5, 0.25, 0.4]], quat, [0.9], np.zeros((1, 1, 3))
    ), camera


def test_depth_limit__plane_through_a_gaussian_agrees_with_the_integral_along_the_ray():
    """Transmittance exp(-integral of the density up to the plane), by quadrature in float64 on
    exact rays.
    """
    gaussians, camera = _large_gaussian()
    columns, rows = np.meshgrid(np.arange(0, camera.width, 6), np.arange(0, camera.height, 6))
    origin, directions = camera.rays(np.stack([columns, rows], axis=-1) + 0.5)
    # The plane 0.5 x - 0.3 y + z = 0, through the mean; `limit` is its depth z in camera space.
    normal = np.array([0.5, -0.3, 1.0])
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    _, rays = camera.rays(np.stack([x, y], axis=-1))
    limit = -(origin @ normal) / (rays @ normal) * (rays @ np.asarray(camera.viewmat)[2, :3])
    Q = reference.rotation(np.asarray(gaussians.quats[0]).ravel())
    precision = Q @ np.diag(1 / np.array([0.5, 0.25, 0.4]) ** 2) @ Q.T
    t = np.linspace(37, 43, 6001)[:, None, None]
    points = origin + t[..., None] * directions
    density = np.exp(-0.5 * np.einsum("...i,ij,...j", points, precision, points, optimize=True))
    fraction = np.sum(density * (points @ normal < 0), axis=0) / np.sum(density, axis=0)

    alpha = np.asarray(rasterize(gaussians, camera, ("alpha",)).alpha, np.float64)[rows, columns, 0]
    cut = render_view(gaussians, ActiveView(camera), ("alpha",), depth_limit=limit)
    cut_alpha = np.asarray(cut.alpha)[rows, columns, 0]
    assert 0.1 < fraction[alpha > 0.5].min() < 0.4 < fraction[alpha > 0.5].max() < 0.9
    # Low-pass filter, affine approximation over 3 degrees, and approximation of the distribution
    # function.
    assert_close(cut_alpha, 1 - (1 - alpha) ** fraction, atol=4e-3)


def test_profile__is_the_depth_of_the_largest_response_along_the_ray():
    """t* = d'S^-1 mu / d'S^-1 d for the ray direction d, in camera space."""
    gaussians, camera = _large_gaussian()
    profile = project(gaussians, camera, ("profile",), RenderConfig()).profile
    z, gx, gy, r_sigma = (float(v[0]) for v in (profile.mean, *profile.slope, profile.r_sigma))
    R = np.asarray(camera.viewmat)[:3, :3] @ reference.rotation(
        np.asarray(gaussians.quats[0]).ravel()
    )
    precision = R @ np.diag(1 / np.array([0.5, 0.25, 0.4]) ** 2) @ R.T
    mean = np.array([0, 0, 40.0])
    for dx, dy in ((0, 0), (9, 0), (0, -7), (8, 8)):
        d = np.array([dx / camera.K[0, 0], dy / camera.K[1, 1], 1])
        exact = d @ precision @ mean / (d @ precision @ d)
        assert z + gx * dx + gy * dy == pytest.approx(exact, abs=0.01)
    assert r_sigma == pytest.approx(np.sqrt(precision[2, 2]), rel=1e-2)


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
    ("make", "message"),
    [
        (
            lambda h, w: np.ones((h, w + 1)),
            r"`depth_limit` must be one depth per pixel, \[18, 21\], got \[18, 22\]",
        ),
        (lambda h, w: np.full((h, w), np.nan), r"one depth per pixel, \[18, 21\], got NaN"),
        (lambda h, w: "far", "`depth_limit` must be"),
    ],
)
def test_depth_limit__refuses_bad_input(scene, make, message):
    raw, camera = scene
    limit = make(camera.height, camera.width)
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

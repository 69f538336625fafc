"""`SplatRays` against the sum over all Gaussians in float64, and against the rasteriser."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from morgs_mi import Gaussians, SplatRays
from morgs_mi.testing import assert_close
from tests.scenes.gaussians import isotropic


def cloud(n=300, scale=0.1, degree=1, seed=0):
    """Return Gaussians of all shapes and orientations in a ball of radius 1."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3))
    means *= rng.uniform(0, 1, (n, 1)) / np.linalg.norm(means, axis=1, keepdims=True)
    return Gaussians.from_activated(
        means,
        scale * rng.uniform(0.05, 2, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(0.001, 0.9, n),
        0.5 * rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )


def segments(n=400, seed=1):
    """Return origins, directions and lengths of segments, most of which begin and end among the
    Gaussians.
    """
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-1.2, 1.2, (n, 3))
    directions = rng.normal(size=(n, 3))
    directions[:6] = [*np.eye(3), *-np.eye(3)]
    return (
        origins,
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        rng.uniform(0.1, 3, n),
    )


def rays(origins, directions, lengths=None):
    ray = mi.Ray3f(mi.Point3f(np.float32(origins.T)), mi.Vector3f(np.float32(directions.T)))
    if lengths is not None:
        ray.maxt = mi.Float(np.float32(lengths))
    return ray


def responses(gaussians, origins, directions, lengths):
    """Return depth and alpha [M, N] of every Gaussian on every segment, by the formulas of the
    module's docstring.
    """
    names = ("means", "scales", "quats", "opacities")
    means, scales, quats, opacities = (
        np.asarray(getattr(gaussians, name), np.float64) for name in names
    )
    axes = Rotation.from_quat(quats, scalar_first=True).as_matrix() / scales[:, None]
    o = np.einsum("nji,mnj->mni", axes, origins[:, None] - means)
    d = np.einsum("nji,mj->mni", axes, directions)
    dd = np.sum(d * d, -1)
    depth = -np.sum(o * d, -1) / dd
    alpha = opacities * np.exp(-0.5 * np.sum((o + depth[..., None] * d) ** 2, -1))
    alpha = np.where(alpha < 1 / 255, 0, np.minimum(alpha, 0.99))
    passed = norm.cdf(np.sqrt(dd) * (lengths[:, None] - depth)) - norm.cdf(-np.sqrt(dd) * depth)
    return depth, 1 - (1 - alpha) ** passed


def reference(gaussians, *segment):
    """Return colour [M, 3] and transmittance [M]."""
    depth, alpha = responses(gaussians, *segment)
    order = depth.argsort(1, kind="stable")
    alpha = np.take_along_axis(alpha, order, 1)
    transmittance = np.cumprod(np.concatenate([np.ones((len(alpha), 1)), 1 - alpha], 1), 1)
    values = dr.sh_eval(mi.Vector3f(np.float32(segment[1].T)), gaussians.sh_degree)
    basis = np.stack([np.broadcast_to(np.array(value, np.float64), len(alpha)) for value in values])
    colors = np.maximum(
        0.5 + np.einsum("km,nkc->mnc", basis, np.asarray(gaussians.sh_coeffs, np.float64)), 0
    )
    colors = np.take_along_axis(colors, order[..., None], 1)
    return np.einsum("mn,mnc->mc", transmittance[:, :-1] * alpha, colors), transmittance[:, -1]


@pytest.mark.parametrize("n", [1, 2, 37, 300])
def test_splat_rays__of_segments_agree_with_the_sum_over_all_gaussians(n):
    gaussians = cloud(n)
    segment = segments()
    color, transmittance = reference(gaussians, *segment)
    traced = SplatRays(gaussians)
    result = traced.trace(rays(*segment))
    # alpha jumps at its lower limit, where float32 and float64 may disagree.
    assert_close(np.array(result[0]).T, color, atol=4e-3)
    for value in (result[1], traced.transmittance(rays(*segment))):
        assert_close(np.array(value), transmittance, atol=4e-3)
        assert np.median(np.abs(np.array(value) - transmittance)) < 1e-6


def test_splat_rays__blend_more_gaussians_than_one_walk_sorts():
    """Sixty Gaussians one inside the other, half of them at equal depths, which are blended in a
    fixed order.
    """
    rng = np.random.default_rng(2)
    means = np.zeros((60, 3))
    means[:30, 2] = rng.permutation(30) / 30
    gaussians = isotropic(means, 1.0, 0.03, rng.uniform(-1.5, 1.5, (60, 1, 3)))
    segment = np.array([[0.0, 0, -9]]), np.array([[0.0, 0, 1]]), np.array([20.0])
    result = SplatRays(gaussians).trace(rays(*segment))
    assert_close(np.array(result[1]), reference(gaussians, *segment)[1], atol=1e-5)
    front = gaussians.select(np.arange(30))
    assert_close(
        np.array(SplatRays(front).trace(rays(*segment))[0]).T,
        reference(front, *segment)[0],
        atol=1e-5,
    )


def test_splat_rays__inactive_rays_meet_nothing():
    ray = rays(*segments(8))
    active = mi.Bool([True] * 4 + [False] * 4)
    traced = SplatRays(cloud())
    color, transmittance = traced.trace(ray, active)
    for value in (transmittance, traced.transmittance(ray, active)):
        assert_array_equal(np.array(value)[4:], 1)
        assert (np.array(value)[:4] < 1).any()
    assert_array_equal(np.array(color)[:, 4:], 0)


def test_splat_rays__of_gaussians_that_are_too_faint_or_too_thin_to_draw():
    ray = rays(np.array([[0.0, 0, -3]]), np.array([[0.0, 0, 1]]))
    faint = isotropic(np.zeros((3, 3)), 1.0, 0.003)
    assert SplatRays(faint).transmittance(ray)[0] == 1
    disc = Gaussians.from_activated(
        [(0, 0, 0)], [(1, 1, 1e-20)], [(1, 0, 0, 0)], [0.5], np.zeros((1, 1, 3))
    )
    assert SplatRays(disc).transmittance(ray)[0] == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize(
    "make", [lambda: "text", lambda: cloud(0)], ids=["no Gaussians", "none of them"]
)
def test_splat_rays__refuse_what_are_no_gaussians(make):
    with pytest.raises(
        ValueError, match=r"SplatRays\(\): `gaussians` must be at least one Gaussian, got a"
    ):
        SplatRays(make())


def test_splat_rays__refuse_numbers_that_are_not_finite():
    gaussians = cloud(5)
    means = gaussians.numpy()["means"]
    means[3, 1] = np.nan
    with pytest.raises(
        ValueError, match=r"`means` must be finite, got nan at \[3, 1\] \(1 such values\)"
    ):
        SplatRays(Gaussians(**{**gaussians.numpy(), "means": means}))

"""Density control: which Gaussians are added and pruned, and their order."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morgs_mi import Camera, Gaussians
from morgs_mi.fit.density import (
    apply_plan,
    plan_additions,
    plan_growth,
)
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.testing import assert_close
from tests import reference
from tests.scenes.gaussians import isotropic

CONFIG = DensityConfig(max_gaussians=100, split_scale=0.1, min_opacity=0.005, births=1.0)


def cloud(n=6, opacity=0.6, scale=0.05, shape=(1, 2, 3)):
    rng = np.random.default_rng(0)
    return Gaussians.from_activated(
        rng.uniform(-1, 1, (n, 3)),
        np.full((n, 3), scale) * shape,
        rng.normal(size=(n, 4)),
        np.full(n, opacity),
        rng.normal(size=(n, 1, 3)),
        logit_confidence=np.arange(n),
    )


def growth(gaussians, error, cameras=()):
    n = len(gaussians)
    return plan_growth(
        gaussians,
        np.asarray(error, float),
        n,
        10.0,
        CONFIG,
        np.random.default_rng(1),
        cameras,
    )


def additions(gaussians, error, **settings):
    config = dataclasses.replace(CONFIG, **settings)
    return plan_additions(gaussians, np.asarray(error, float), config, np.random.default_rng(1))


def test_plan_additions__survivors_come_first_and_births_last():
    faint = dataclasses.replace(cloud(), logit_opacities=np.array([1, -9, 1, 1, -9, 1.0]))
    plan = additions(faint, [0, 9, 5, 1, 8, 3], births=1 / 3)
    assert plan.source.tolist() == [0, 2, 3, 5, -1, -1]
    assert plan.parent.tolist() == [0, 2, 3, 5, 2, 5]  # the survivors with the largest error


@pytest.mark.parametrize(("limit", "births"), [(3, 0), (6, 0), (7, 1)])
def test_plan_additions__leaves_all_visible_gaussians_at_the_limit(limit, births):
    """Four static Gaussians count, too."""
    config = dataclasses.replace(CONFIG, births=0.2, max_gaussians=limit + 4)
    plan = plan_additions(cloud(), np.arange(6.0), config, np.random.default_rng(1), 4)
    assert ((plan.source < 0).sum(), len(plan.source)) == (births, 6 + births)
    assert plan.parent[6:].tolist() == [5][:births]


def test_plan_additions__adds_none_without_error_and_never_prunes_all():
    assert additions(cloud(), np.full(6, CONFIG.min_error)).source.min() >= 0
    assert len(additions(cloud(opacity=1e-4), np.zeros(6)).source) == 6


def test_plan_growth__clones_small_gaussians_with_the_same_coverage():
    gaussians = cloud(scale=0.05)
    result = apply_plan(gaussians, growth(gaussians, [0, 0, 0, 0, 0, 1]))
    o = np.asarray(result.opacities)
    scales = np.asarray(result.scales)
    assert 1 - (1 - o[5]) * (1 - o[6]) == pytest.approx(0.6, rel=1e-5)
    assert_close(o[:5], np.full(5, 0.6), rtol=1e-6)
    assert scales[6] == pytest.approx(np.asarray(gaussians.scales)[5], rel=1e-5)


def test_plan_growth__splits_large_round_gaussians_and_keeps_means():
    gaussians = cloud(scale=1.0, shape=(1, 2, 3.9))
    result = apply_plan(gaussians, growth(gaussians, [0, 0, 0, 0, 0, 1]))
    assert np.asarray(result.scales)[5:] == pytest.approx(
        np.tile([1, 2, 3.9], (2, 1)) / 1.6, rel=1e-5
    )
    assert_close(result.opacities, np.full(7, 0.6), rtol=1e-5)
    assert np.array_equal(np.asarray(result.means)[:6], np.asarray(gaussians.means))


def test_plan_growth__splits_large_long_gaussians_along_their_longest_axis():
    gaussians = cloud(scale=1.0, shape=(1, 2, 4.1))
    result = apply_plan(gaussians, growth(gaussians, [0, 0, 0, 0, 0, 1]))
    means = np.asarray(result.means)
    whole = np.asarray(gaussians.means)
    offset = means[6] - means[5]
    axes = Rotation.from_quat(np.asarray(gaussians.quats)[5], scalar_first=True).as_matrix()
    assert np.asarray(result.scales)[5:] == pytest.approx(
        np.tile([0.893, 2 * 0.893, 4.1 * 0.55], (2, 1)), rel=1e-5
    )
    assert_close(result.opacities, [0.6] * 5 + [0.36] * 2, rtol=1e-5)
    assert np.array_equal(means[:5], whole[:5])
    assert (means[5] + means[6]) / 2 == pytest.approx(whole[5], abs=1e-5)
    assert np.abs(offset @ axes) == pytest.approx([0, 0, 2 * 1.35 * 4.1], abs=1e-4)
    assert np.asarray(result.logit_confidence)[6] == 5


def test_plan_growth__leaves_the_space_before_near_planes_empty():
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), 40, 64, 48)
    camera = dataclasses.replace(camera, near=3.0)
    z = np.where(np.arange(400) < 100, -2.0, -0.99)  # before and close behind the near plane at -1
    crowd = isotropic(np.stack([0 * z, 0 * z, z], 1), 0.05, 0.6, 0.5)
    plan = growth(crowd, np.ones(400), [camera])
    result = apply_plan(crowd, plan)
    assert len(plan.source) - (plan.source < 0).sum() == 300
    assert plan.source[:300].tolist() == list(range(100, 400))
    assert (plan.source < 0).sum() == 300
    assert np.asarray(result.means)[:, 2].min() >= -1
    assert np.asarray(apply_plan(crowd, growth(crowd, np.ones(400))).means)[:, 2].min() < -2


def test_plan_additions__births_are_faint_and_parents_unchanged():
    gaussians = cloud(scale=1.0)
    result = apply_plan(gaussians, additions(gaussians, [0, 0, 0, 0, 0, 1]))
    for name, value in result.numpy().items():
        assert np.array_equal(value[:6], gaussians.numpy()[name]), name
    assert np.asarray(result.opacities)[6] == pytest.approx(0.1, rel=1e-5)
    assert np.asarray(result.scales)[6] == pytest.approx(np.array([1, 2, 3]) / 1.6, rel=1e-5)


def test_density_plan__opaque_parents_have_finite_births():
    gaussians = dataclasses.replace(cloud(), logit_opacities=np.full(6, 40.0))
    for plan in (growth(gaussians, np.ones(6)), additions(gaussians, np.ones(6))):
        for name, value in apply_plan(gaussians, plan).numpy().items():
            assert np.isfinite(value).all(), name


def test_plan_growth__draws_births_from_the_parents_density():
    """Whitened by the parent's axes, thousands of births have zero mean and unit covariance."""
    n = 4000
    one = cloud(1, scale=0.05)
    plan = growth(one.select(np.zeros(n, int)), np.ones(n))
    axes = reference.rotation(one.numpy()["quats"][0].astype(float))
    white = plan.edits["means"][n:] @ axes / np.asarray(one.scales)
    # Standard errors of 4000 draws are 0.016 for means and 0.022 for variances.
    assert np.abs(white.mean(0)).max() < 0.08
    assert np.abs(np.cov(white.T) - np.eye(3)).max() < 0.1

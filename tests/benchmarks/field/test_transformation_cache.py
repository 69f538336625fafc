"""Neural transformation cache: the hash grid, the network's motion and its gradient."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks.field.transformation_cache import CacheConfig, hash_matrix, transformation_cache
from tests.assertions import assert_close
from tests.scenes.gaussians import make_wide_scene, to_gaussians

GAUSSIANS = to_gaussians(make_wide_scene(30))
EXTENT = 2.0
CONFIG = CacheConfig(levels=3, table=64, features=2, hidden=8)


def random_parameters(model, seed: int = 0) -> dict[str, mi.TensorXf]:
    rng = np.random.default_rng(seed)
    return {
        n: mi.TensorXf(rng.normal(0, 0.3, tuple(v.shape)).astype(np.float32))
        for n, v in model.parameters.items()
    }


def test_hash_matrix__interpolates_between_eight_entries_of_each_level():
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    matrix = hash_matrix(points, [0.5, 0.25], 4096)
    assert matrix.shape == (40, 8192)
    assert matrix.sum(axis=1) == pytest.approx(np.ones(40), abs=1e-6)
    dense = matrix.toarray()
    assert not dense[::2, 4096:].any()  # the first level reads the first table only
    assert not dense[1::2, :4096].any()


def test_hash_matrix__is_continuous_across_cells():
    sides = [np.array([[0.5 + s * 1e-6, 0.1, -0.3]]) for s in (-1, 1)]
    below, above = (hash_matrix(point, [0.5], 4096).toarray() for point in sides)
    assert_close(below, above, atol=1e-4)


def test_transformation_cache__starts_without_motion():
    model = transformation_cache(GAUSSIANS, EXTENT, np.random.default_rng(0), CONFIG)
    displacement, rotation = model.motion(model.parameters)
    assert not np.asarray(displacement).any()
    assert not np.asarray(rotation).any()


def reference(p: dict[str, np.ndarray]) -> np.ndarray:
    """Return displacement in units of the output, and rotation, in float64 [N, 7]."""
    sides = [CONFIG.coarsest * EXTENT / 2**level for level in range(CONFIG.levels)]
    code = hash_matrix(np.asarray(GAUSSIANS.means), sides, CONFIG.table) @ p["table"]
    return np.maximum(np.maximum(code.reshape(30, -1) @ p["first"], 0) @ p["second"], 0) @ p["last"]


def test_transformation_cache__is_the_network_of_its_definition():
    model = transformation_cache(GAUSSIANS, EXTENT, np.random.default_rng(0), CONFIG)
    p = random_parameters(model)
    output = reference({name: np.asarray(value, np.float64) for name, value in p.items()})
    displacement, rotation = model.motion(p)
    assert_close(displacement, output[:, :3] * CONFIG.displacement * EXTENT, atol=1e-5)
    assert_close(rotation, output[:, 3:], atol=1e-5)


@pytest.mark.parametrize("name", ["table", "first", "second", "last"])
def test_transformation_cache__gradients_agree_with_central_differences(name):
    model = transformation_cache(GAUSSIANS, EXTENT, np.random.default_rng(0), CONFIG)
    rng = np.random.default_rng(1)
    p = random_parameters(model)
    weight = rng.normal(size=(30, 4)).astype(np.float32)
    values = {n: np.asarray(v, np.float64) for n, v in p.items()}
    dr.enable_grad(p[name])
    dr.backward(dr.sum(mi.TensorXf(weight) * model.motion(p)[1], axis=None))
    direction = rng.normal(size=values[name].shape)
    step = 1e-6
    ends = [
        reference({**values, name: values[name] + s * step * direction})[:, 3:] for s in (1, -1)
    ]
    expected = np.vdot(weight, ends[0] - ends[1]) / (2 * step)
    assert np.vdot(np.asarray(dr.grad(p[name])), direction) == pytest.approx(expected, rel=1e-4)

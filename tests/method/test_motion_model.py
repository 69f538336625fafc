"""Motion models: products with a sparse matrix, moved Gaussians, and the gradients of both."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from morgs_mi.core.geometry import unit_quats
from morgs_mi.method.motion_model import moved, sparse_product
from morgs_mi.testing import assert_close
from tests.scenes.derivatives import backward, difference, gradient
from tests.scenes.gaussians import make_scene, to_gaussians

RNG = np.random.default_rng(3)
MATRIX = csr_array(RNG.normal(size=(9, 5)) * (RNG.random((9, 5)) < 0.4), dtype=np.float32)


def tensor(*shape):
    return mi.TensorXf(RNG.normal(size=shape).astype(np.float32))


def test_sparse_product__has_an_adjoint_in_both_modes():
    x = tensor(5, 3)
    weight = tensor(9, 3)
    dr.enable_grad(x)
    backward(weight * sparse_product(MATRIX, x))
    assert_close(dr.grad(x), MATRIX.toarray().T @ np.asarray(weight), atol=1e-6)
    x = dr.detach(x)
    dr.enable_grad(x)
    tangent = tensor(5, 3)
    dr.set_grad(x, tangent)
    assert_close(
        dr.forward_to(sparse_product(MATRIX, x)), MATRIX.toarray() @ np.asarray(tangent), atol=1e-6
    )


def test_moved__shifts_means_and_turns_rotations():
    gaussians = to_gaussians(make_scene())
    shift = tensor(10, 3)
    turns = Rotation.random(10, rng=RNG)
    quats = turns.as_quat(scalar_first=True) - (1, 0, 0, 0)
    result = moved(gaussians, shift, mi.TensorXf(quats.astype(np.float32)))
    assert_close(result.means, np.asarray(gaussians.means) + np.asarray(shift), atol=1e-6)
    rotations, new_rotations = (
        Rotation.from_quat(unit_quats(g), scalar_first=True) for g in (gaussians, result)
    )
    assert_close(new_rotations.as_matrix(), (turns * rotations).as_matrix(), atol=1e-5)


def test_moved__gradients_agree_with_central_differences():
    gaussians = to_gaussians(make_scene())
    weight = tensor(10, 4)
    rotation = tensor(10, 4)
    direction = np.asarray(tensor(10, 4))

    def value(rotation):
        rotation = mi.TensorXf(rotation)
        return dr.sum(
            weight * moved(gaussians, dr.zeros(mi.TensorXf, (10, 3)), rotation).quats, axis=None
        )

    dr.enable_grad(rotation)
    dr.backward(value(rotation))
    derivative = np.vdot(gradient(rotation), direction)
    slope = difference(value, dr.detach(rotation), direction, 0.5)  # linear in the rotation
    assert slope == pytest.approx(derivative, rel=1e-4)

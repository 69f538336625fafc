"""Covariances, spherical harmonics and rotated axes, against the float64 reference and the
renderer.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import covariances, rotated, sh_basis
from morgs_mi.render.rasterize import rasterize
from morgs_mi.testing import assert_close
from tests import reference

R = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()


def cloud(N=30, degree=3):
    rng = np.random.default_rng(degree)
    return Gaussians(
        rng.uniform(-1, 1, (N, 3)),
        rng.uniform(-3, -1, (N, 3)),
        rng.normal(size=(N, 4)),
        rng.normal(size=N),
        0.3 * rng.normal(size=(N, (degree + 1) ** 2, 3)),
        motion=0.1 * rng.normal(size=(N, 3)),
        logit_confidence=rng.normal(size=N),
    )


def test_covariances__agree_with_the_reference():
    raw = cloud().numpy()
    matrices = covariances(cloud())
    for log_scale, quat, covariance in zip(
        raw["log_scales"], raw["quats"].astype(float), matrices, strict=True
    ):
        M = reference.rotation(quat) * np.exp(log_scale)
        assert_allclose(covariance, M @ M.T, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("degree", range(4))
def test_sh_basis__agrees_with_the_reference(degree):
    directions = cloud().numpy()["means"] - np.array([0.2, 0.1, -4])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = np.stack([np.stack(reference.sh_basis(d, degree)) for d in directions])
    assert_close(sh_basis(directions, degree), expected, atol=2e-6)  # float32 polynomials


@pytest.mark.parametrize("degree", range(4))
def test_rotated__looks_the_same_to_a_rotated_camera(degree):
    camera = Camera.look_at((0.2, 0.1, -4), (0, 0, 0), (0, -1, 0), 45, 48, 40)
    turn = np.eye(4)
    turn[:3, :3] = R.T
    turned = replace(camera, viewmat=camera.viewmat @ turn)
    gaussians = cloud(degree=degree)
    channels = ("color", "motion", "depth", "confidence")
    a = rasterize(gaussians, camera, channels)
    b = rasterize(rotated(gaussians, R), turned, channels)
    vectors = replace(gaussians, offset=gaussians.motion)
    assert_array_equal(rotated(vectors, R).offset, rotated(vectors, R).motion)
    for name in channels:
        # A rotation rounds every attribute once in float32; nearly equal depths do not swap on
        # these seeds.
        assert_close(getattr(b, name), getattr(a, name), atol=2e-4, name=name)

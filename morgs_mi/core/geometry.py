"""Gaussians in NumPy, as other programs need them: covariances, spherical harmonics, rotated axes.

N Gaussians, K = (degree + 1)^2 SH coefficients; R [3, 3] is a rotation that takes column vectors,
x' = R x.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.core.camera import unit_vectors
from morgs_mi.core.gaussians import Gaussians


def unit_quats(gaussians: Gaussians) -> np.ndarray:
    """Return the rotations as unit quaternions wxyz, float64 [N, 4]; a quaternion of length 0
    becomes the identity.
    """
    quats = np.asarray(gaussians.numpy()["quats"], np.float64)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(lengths > 0, quats / np.maximum(lengths, 1e-300), (1.0, 0, 0, 0))


def covariances(gaussians: Gaussians) -> np.ndarray:
    """Return the covariances in world axes, float64 [N, 3, 3]."""
    axes = _rotations(gaussians).as_matrix()
    axes = axes * np.exp(np.asarray(gaussians.numpy()["log_scales"], np.float64))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the spherical harmonics of unit directions [M, 3] with 3DGS's signs, [M, K]."""
    basis = dr.sh_eval(mi.Vector3f(directions.T), degree)
    return np.stack(
        [np.broadcast_to(np.asarray(values), len(directions)) for values in basis], axis=1
    )


def rotated(gaussians: Gaussians, R: np.ndarray) -> Gaussians:
    """Return the Gaussians rotated by R [3, 3]: means, rotations, spherical harmonics, motion and
    offset.

    A colour that was seen along d is then seen along R d. A rotation maps the harmonics of one
    degree to themselves: the new coefficients follow exactly from enough directions to make the
    basis invertible.
    """
    R = np.asarray(R, np.float64)
    turns = Rotation.from_matrix(R) * _rotations(gaussians)
    raw = gaussians.numpy()
    vectors = {name: raw[name] @ R.T for name in ("means", "motion", "offset") if name in raw}
    # More than twice as many directions as the 16 functions of degree 3.
    directions = unit_vectors(np.random.default_rng(0).normal(size=(40, 3)))
    basis, turned_basis = (sh_basis(d, gaussians.sh_degree) for d in (directions, directions @ R))
    coeffs = np.einsum("kl,nlc->nkc", np.linalg.pinv(basis) @ turned_basis, raw["sh_coeffs"])
    return replace(gaussians, quats=turns.as_quat(scalar_first=True), sh_coeffs=coeffs, **vectors)


def _rotations(gaussians: Gaussians) -> Rotation:
    return Rotation.from_quat(unit_quats(gaussians), scalar_first=True)

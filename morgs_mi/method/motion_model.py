"""Motion models: a few parameters that move all Gaussians, fitted before each Gaussian has a
residual of its own.

3DGStream, HiCoM and 4DGC fit a later frame in two stages: first a motion that Gaussians share, then
the remaining change. A model is the first stage. It maps its parameters to a displacement d of
every Gaussian and to a rotation r, a quaternion,

    mu' = mu + d,    q' = r q    (Hamilton product),

and the residual (eq. 12) starts from there. `fit.later_frame` fits it. The spherical harmonics are
not rotated.

The setting `motion.model` selects a model of `MOTION_MODELS`. The package has none; models of other
publications are in benchmarks/field, and docs/extending.md describes how to register one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Jit, Tensor, Tensors
from morgs_mi.method.method_registry import Registry


@dataclass(frozen=True, eq=False)
class MotionModel:
    """A motion that N Gaussians share."""

    parameters: Tensors  #: Tensors at their start, by name, for which nothing moves.
    rates: Mapping[str, float]  #: Adam's learning rate of each, by name.
    #: Parameters -> (displacements [N, 3] in world units, rotations [N, 4] minus the identity,
    #: wxyz).
    motion: Callable[[Tensors], tuple[Tensor, Tensor]]
    #: Parameters -> weighted losses in addition to L_recon, by name.
    losses: Callable[[Tensors], Tensors] = lambda parameters: {}


# (N Gaussians of the previous frame, extent of the scene in world units, random generator) ->
# model.
MotionModelFactory = Callable[[Gaussians, float, np.random.Generator], MotionModel]

MOTION_MODELS: Registry[MotionModelFactory | None, Any] = Registry(
    "MotionConfig()", "model", lambda: None
)
"""Models by name; ``none`` is None. Their factories get the `MotionConfig`."""
MOTION_MODELS.register("none")(lambda argument, config: None)


def moved(gaussians: Gaussians, displacement: Tensor, rotation: Tensor) -> Gaussians:
    """Return N Gaussians after a motion, as a `MotionModel` gives it."""
    q: Jit = dr.unravel(mi.Vector4f, gaussians.quats.array)
    r: Jit = dr.unravel(mi.Vector4f, rotation.array)
    product: Jit = dr.ravel(quaternion_product(r + mi.Vector4f(1, 0, 0, 0), q))
    quats = mi.TensorXf(product, tuple(gaussians.quats.shape))
    motion = displacement if gaussians.motion is None else gaussians.motion + displacement
    return replace(gaussians, means=gaussians.means + displacement, motion=motion, quats=quats)


def quaternion_product(r: Jit, q: Jit) -> Jit:
    """Return the Hamilton product of quaternions wxyz."""
    a, b, c, d = r
    w, x, y, z = q
    return mi.Vector4f(
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def sparse_product(matrix: csr_array, x: Tensor) -> Tensor:
    """Return W x [N, K] of a constant matrix W [N, C] and a tensor x [C, K], differentiable in x.

    A gather's adjoint would add atomically, in no fixed order; this one is a product with the
    transpose.
    """
    return dr.custom(_SparseProduct, x, matrix)


class _SparseProduct(dr.CustomOp):
    def eval(self, x: Tensor, matrix: csr_array) -> Tensor:
        self.matrix = matrix
        return from_numpy(mi.TensorXf, matrix @ np.asarray(x))

    def backward(self) -> None:
        self.set_grad_in("x", from_numpy(mi.TensorXf, self.matrix.T @ np.asarray(self.grad_out())))

    def forward(self) -> None:
        self.set_grad_out(from_numpy(mi.TensorXf, self.matrix @ np.asarray(self.grad_in("x"))))

"""Motion grid with its rate in the loss, after 4DGC (Hu et al., CVPR 2025).

Grids at several levels have a translation and a rotation at every corner of a cell with Gaussians.
A Gaussian moves by the sum over the levels, each interpolated between the 8 corners around its
mean. The values count in steps, to which they are rounded (the gradient passes the rounding
unchanged), and the loss contains the bits that an entropy coder would need for them: the values x
of a level are logistic with a learned scale b,

    bits = -log2(S((x + 1/2) / b) - S((x - 1/2) / b)),    S the sigmoid.

Motion that the images hardly need becomes 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import log

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array, hstack

from benchmarks.field.shared import CELLS, RATES, corners, quantised
from morgs_mi.core.attributes import sigmoid
from morgs_mi.core.gaussians import Gaussians, repeat_each
from morgs_mi.core.types import Float, Tensor
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import (
    MOTION_MODELS,
    MotionModel,
    MotionModelFactory,
    sparse_product,
)

# Least probability of a value, which bounds its bits.
_LEAST = 1e-6
# Steps: of translations in scene extents, and of rotations.
_STEPS = {"translation": 1e-4, "rotation": 1e-3}
# Scale b at the start, in steps, and the learning rate of its logarithm.
_SCALE = 4.0
_SCALE_RATE = 0.05
# Weight of the bits per Gaussian.
_RATE_WEIGHT = 1e-4
# Beside the default, most motion is known when the grid begins.
_SLOW = {"translation": 5e-4, "rotation": 2e-3}


def motion_grid(gaussians: Gaussians, extent: float, rates: Mapping[str, float]) -> MotionModel:
    """Return the model of N Gaussians of the previous frame.

    Args:
        gaussians: of the previous frame.
        extent: of the scene, world units.
        rates: learning rates of the translations, in scene extents, and of the rotations.
    """
    N = len(gaussians)
    L = len(CELLS)
    matrix, level = corner_matrix(np.asarray(gaussians.means), extent)
    C = len(level)
    of_level = csr_array((np.ones(C, np.float32), level, np.arange(C + 1)), (C, L))
    steps = _STEPS | {"translation": _STEPS["translation"] * extent}

    def motion(p: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        return tuple(
            sparse_product(matrix, quantised(p[name], 1.0)) * step for name, step in steps.items()
        )

    def rate(p: Mapping[str, Tensor]) -> dict[str, Tensor]:
        scales = dr.exp(sparse_product(of_level, p["log_scales"]))
        of_kind = zip(steps, (scales[:, 0].array, scales[:, 1].array), strict=True)
        total = sum(
            dr.sum(bits(p[name].array, repeat_each(b, int(p[name].shape[1]))))
            for name, b in of_kind
        )
        return {"rate": total * (_RATE_WEIGHT / N)}

    return MotionModel(
        {
            "translation": dr.zeros(mi.TensorXf, (C, 3)),
            "rotation": dr.zeros(mi.TensorXf, (C, 4)),
            "log_scales": dr.full(mi.TensorXf, log(_SCALE), (L, 2)),
        },
        {**{name: rates[name] / step for name, step in _STEPS.items()}, "log_scales": _SCALE_RATE},
        motion,
        rate,
    )


@MOTION_MODELS.register("grid")
def _grid(argument: str, config: MotionConfig) -> MotionModelFactory:
    return lambda gaussians, extent, rng: motion_grid(gaussians, extent, RATES)


@MOTION_MODELS.register("grid-slow")
def _slow_grid(argument: str, config: MotionConfig) -> MotionModelFactory:
    return lambda gaussians, extent, rng: motion_grid(gaussians, extent, _SLOW)


def bits(x: Float, scale: Float) -> Float:
    """Return the bits of values x, in steps, under a logistic density of scale b."""
    probability: Float = sigmoid((x + 0.5) / scale) - sigmoid((x - 0.5) / scale)
    return dr.log2(dr.maximum(probability, _LEAST)) * -1.0


def corner_matrix(points: np.ndarray, extent: float) -> tuple[csr_array, np.ndarray]:
    """Return the weights [N, C] of the corners around points [N, 3] on all levels, and the level
    of each corner [C]; `extent` of the scene in world units.
    """
    matrices = []
    for side in CELLS:
        corner, weights = corners(points, side * extent)
        _, index = np.unique(corner.reshape(-1, 3), axis=0, return_inverse=True)
        starts = np.arange(0, 8 * len(points) + 1, 8)
        matrices.append(csr_array((weights.ravel(), index.ravel(), starts)))
    levels = np.repeat(np.arange(len(CELLS)), [matrix.shape[1] for matrix in matrices])
    return csr_array(hstack(matrices, format="csr")), levels

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array, hstack

from benchmarks.field.shared import corners, quantised
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


@dataclass(frozen=True)
class GridConfig:
    """Settings of the motion grid."""

    cells: tuple[float, ...] = (0.4, 0.2, 0.1, 0.05)
    """Side of the cells of each level, in scene extents."""
    translation_step: float = 1e-4
    """Step of the translations, in scene extents."""
    rotation_step: float = 1e-3
    """Step of the rotations."""
    translation_rate: float = 4e-3
    """Learning rate of the translations at the start, in scene extents; it falls to a tenth."""
    rotation_rate: float = 8e-3
    """Learning rate of the rotations, likewise."""
    scale: float = 4.0
    """Scale b at the start, in steps."""
    scale_rate: float = 0.05
    """Learning rate of the logarithms of the scales."""
    rate_weight: float = 1e-4
    """Weight of the bits per Gaussian."""


# Beside the default, most motion is known when the grid begins.
_SLOW = GridConfig(translation_rate=5e-4, rotation_rate=2e-3)


def motion_grid(gaussians: Gaussians, extent: float, config: GridConfig) -> MotionModel:
    """Return the model of N Gaussians of the previous frame; `extent` of the scene, world units."""
    matrix, level = corner_matrix(
        np.asarray(gaussians.means), [side * extent for side in config.cells]
    )
    C = len(level)
    N = len(gaussians)
    L = len(config.cells)
    of_level = csr_array((np.ones(C, np.float32), level, np.arange(C + 1)), (C, L))
    steps = {"translation": config.translation_step * extent, "rotation": config.rotation_step}

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
        return {"rate": total * (config.rate_weight / N)}

    return MotionModel(
        {
            "translation": dr.zeros(mi.TensorXf, (C, 3)),
            "rotation": dr.zeros(mi.TensorXf, (C, 4)),
            "log_scales": dr.full(mi.TensorXf, log(config.scale), (L, 2)),
        },
        {
            "translation": config.translation_rate / config.translation_step,
            "rotation": config.rotation_rate / config.rotation_step,
            "log_scales": config.scale_rate,
        },
        motion,
        rate,
    )


@MOTION_MODELS.register("grid")
def _grid(argument: str, config: MotionConfig) -> MotionModelFactory:
    return lambda gaussians, extent, rng: motion_grid(gaussians, extent, GridConfig())


@MOTION_MODELS.register("grid-slow")
def _slow_grid(argument: str, config: MotionConfig) -> MotionModelFactory:
    return lambda gaussians, extent, rng: motion_grid(gaussians, extent, _SLOW)


def bits(x: Float, scale: Float) -> Float:
    """Return the bits of values x, in steps, under a logistic density of scale b."""
    probability: Float = sigmoid((x + 0.5) / scale) - sigmoid((x - 0.5) / scale)
    return dr.log2(dr.maximum(probability, _LEAST)) * -1.0


def corner_matrix(points: np.ndarray, sides: Sequence[float]) -> tuple[csr_array, np.ndarray]:
    """Return the weights [N, C] of the corners around points [N, 3], on all levels, and the level
    of each corner [C].

    Args:
        points: world units.
        sides: of the cells of each level, world units.
    """
    matrices = []
    for side in sides:
        corner, weights = corners(points, side)
        _, index = np.unique(corner.reshape(-1, 3), axis=0, return_inverse=True)
        matrices.append(
            csr_array((weights.ravel(), index.ravel(), np.arange(0, 8 * len(points) + 1, 8)))
        )
    levels = np.repeat(np.arange(len(sides)), [matrix.shape[1] for matrix in matrices])
    return csr_array(hstack(matrices, format="csr")), levels

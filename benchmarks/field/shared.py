"""Parts that several motion models share: sums of motions, cells with corners, and rounded
parameters.
"""

from __future__ import annotations

from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array

from morgs_mi.core.types import Tensor
from morgs_mi.method.motion_model import MotionModel, sparse_product

# Learning rates at the start: of translations in scene extents, and of rotations. They fall to a
# tenth.
RATES = {"translation": 4e-3, "rotation": 8e-3}
# Sides of the cells of each level, in scene extents.
CELLS = (0.4, 0.2, 0.1, 0.05)


def summed_motion(
    matrix: csr_array, extent: float, translation_step: float = 0.0, rotation_step: float = 0.0
) -> MotionModel:
    """Return the model in which N Gaussians move by sums of A translations and rotations.

    Args:
        matrix: weights of the summands [N, A].
        extent: of the scene, world units.
        translation_step: step of the translations, in scene extents; 0: not rounded.
        rotation_step: step of the rotations; 0: not rounded.
    """
    _, size = cast("tuple[int, int]", matrix.shape)
    steps = {"translation": translation_step * extent, "rotation": rotation_step}
    return MotionModel(
        {
            "translation": dr.zeros(mi.TensorXf, (size, 3)),
            "rotation": dr.zeros(mi.TensorXf, (size, 4)),
        },
        RATES | {"translation": RATES["translation"] * extent},
        lambda p: tuple(
            sparse_product(matrix, quantised(p[name], step)) for name, step in steps.items()
        ),
    )


def corners(points: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [N, 8, 3] of the cubic cells around points [N, 3], integers, and their
    weights [N, 8] in trilinear interpolation; `side` of the cells in world units.
    """
    lowest = np.floor(points / side)
    offsets = np.indices((2, 2, 2)).reshape(3, 8).T
    fraction = points / side - lowest
    weights = np.prod(np.where(offsets, fraction[:, None], 1 - fraction[:, None]), axis=-1)
    return lowest.astype(np.int64)[:, None] + offsets, weights.astype(np.float32)


def quantised(values: Tensor, step: float) -> Tensor:
    """Return values rounded to multiples of a step, with the gradient of what is not rounded; 0
    rounds nothing.
    """
    if not step:
        return values
    fixed = dr.detach(values)
    return values + (dr.round(fixed / step) * step - fixed)

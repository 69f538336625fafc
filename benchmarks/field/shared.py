"""Parts that several motion models share: cells with corners, and rounded parameters."""

from __future__ import annotations

import drjit as dr
import numpy as np

from morgs_mi.core.types import Tensor


def corners(points: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the cubic cells around points, and their weights in trilinear
    interpolation.

    Args:
        points: [N, 3], world units.
        side: of the cells, world units.

    Returns:
        Integer coordinates [N, 8, 3], and weights float32 [N, 8], which sum to 1.
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

"""Hierarchical coherent motion, after HiCoM (Gao et al., NeurIPS 2024).

The space of the Gaussians is divided into cubic cells, at several levels from coarse to fine. Every
cell of every level has a translation and a rotation, and a Gaussian moves by the sum over the cells
that contain it,

    d_i = sum_l t_l(i),    r_i = 1 + sum_l q_l(i).

The coarse levels move objects, and the fine ones move the remainder. Only cells with Gaussians have
parameters.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, hstack

from benchmarks.field.shared import CELLS, summed_motion
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import MOTION_MODELS, MotionModelFactory


@MOTION_MODELS.register("hicom")
def coherent_motion(argument: str, config: MotionConfig) -> MotionModelFactory:
    """Return the factory of the model."""
    return lambda gaussians, extent, rng: summed_motion(
        cell_matrix(np.asarray(gaussians.means), extent), extent
    )


def cell_matrix(points: np.ndarray, extent: float) -> csr_array:
    """Return the memberships [N, C] of points [N, 3] in the cells of all levels that are not empty:
    0 or 1; `extent` of the scene in world units.
    """
    levels = []
    for side in CELLS:
        # A shift by half a cell keeps the origin, where captures often have their subject, inside
        # one.
        cells = np.floor(points / (side * extent) + 0.5).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        rows = np.arange(len(points) + 1)
        levels.append(csr_array((np.ones(len(points), np.float32), cell.ravel(), rows)))
    return csr_array(hstack(levels, format="csr"))

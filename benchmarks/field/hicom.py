"""Hierarchical coherent motion, after HiCoM (Gao et al., NeurIPS 2024).

The space of the Gaussians is divided into cubic cells, at several levels from coarse to fine. Every
cell of every level has a translation and a rotation, and a Gaussian moves by the sum over the cells
that contain it,

    d_i = sum_l t_l(i),    r_i = 1 + sum_l q_l(i).

The coarse levels move objects, and the fine ones move the remainder. Only cells with Gaussians have
parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array, hstack

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import (
    MOTION_MODELS,
    MotionModel,
    MotionModelFactory,
    sparse_product,
)


@dataclass(frozen=True)
class HicomConfig:
    """Settings of the hierarchical coherent motion."""

    cells: tuple[float, ...] = (0.4, 0.2, 0.1, 0.05)
    """Side of the cells of each level, in scene extents."""
    translation_rate: float = 4e-3
    """Learning rate of the translations at the start, in scene extents; it falls to a tenth."""
    rotation_rate: float = 8e-3
    """Learning rate of the rotations at the start; it falls to a tenth."""


def coherent_motion(gaussians: Gaussians, extent: float, config: HicomConfig) -> MotionModel:
    """Return the model of N Gaussians; `extent` of the scene in world units."""
    cells = cell_matrix(np.asarray(gaussians.means), [side * extent for side in config.cells])
    count = len(np.unique(cells.indices))
    return MotionModel(
        {
            "translation": dr.zeros(mi.TensorXf, (count, 3)),
            "rotation": dr.zeros(mi.TensorXf, (count, 4)),
        },
        {"translation": config.translation_rate * extent, "rotation": config.rotation_rate},
        lambda p: (sparse_product(cells, p["translation"]), sparse_product(cells, p["rotation"])),
    )


@MOTION_MODELS.register("hicom")
def _hicom(argument: str, config: MotionConfig) -> MotionModelFactory:
    return lambda gaussians, extent, rng: coherent_motion(gaussians, extent, HicomConfig())


def cell_matrix(points: np.ndarray, sides: Sequence[float]) -> csr_array:
    """Return the memberships [N, C] of points [N, 3] in the cells of all levels that are not empty:
    0 or 1.

    Args:
        points: world units.
        sides: of the cells of each level, world units.
    """
    levels = []
    for side in sides:
        # A shift by half a cell keeps the origin, where captures often have their subject, inside
        # one.
        _, cell = np.unique(
            np.floor(points / side + 0.5).astype(np.int64), axis=0, return_inverse=True
        )
        rows = np.arange(len(points) + 1)
        levels.append(csr_array((np.ones(len(points), np.float32), cell.ravel(), rows)))
    return csr_array(hstack(levels, format="csr"))

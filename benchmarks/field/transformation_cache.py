"""Neural transformation cache, after 3DGStream (Sun et al., CVPR 2024).

A multiresolution hash grid (Mueller et al. 2022, *Instant neural graphics primitives*) encodes the
mean of a Gaussian in the previous frame, and a small network maps the code to its displacement and
its rotation,

    (d_i / s, q_i) = C max(0, B max(0, A h(mu_i))),    r_i = 1 + q_i.

Level l has cells of side s_l. Their corners are entries of a table of limited size by a hash of
their coordinates; h are the entries of all levels, each interpolated between the 8 corners around
the mean. The means do not change while the cache is fitted: h is the product of a constant sparse
matrix and the tables. C starts at 0: nothing moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array

from benchmarks.field.shared import corners
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import (
    MOTION_MODELS,
    MotionModel,
    MotionModelFactory,
    sparse_product,
)

# Of the hash by Mueller et al.
_PRIMES = np.array([1, 2_654_435_761, 805_459_861], np.uint64)


@dataclass(frozen=True)
class CacheConfig:
    """Settings of the transformation cache."""

    levels: int = 6
    """Levels of the hash grid, each with cells of half the side of the one before."""
    coarsest: float = 0.8
    """Side of the cells of the first level, in scene extents."""
    table: int = 4096
    """Entries of each level's table; corners beyond that share entries."""
    features: int = 4
    """Numbers of an entry."""
    hidden: int = 64
    """Width of the two hidden layers."""
    spread: float = 0.5
    """Largest number of an entry at the start."""
    displacement: float = 0.1
    """Displacement for an output of 1, in scene extents."""
    rate: float = 2e-3
    """Learning rate of the network's weights at the start; it falls to a tenth."""
    table_rate: float = 0.1
    """Learning rate of the tables, likewise."""


def transformation_cache(
    gaussians: Gaussians, extent: float, rng: np.random.Generator, config: CacheConfig
) -> MotionModel:
    """Return the model of N Gaussians.

    Args:
        gaussians: of the previous frame, detached.
        extent: of the scene, world units.
        rng: draws the weights and the tables.
        config: settings.
    """
    N = len(gaussians)
    L = config.levels
    F = config.features
    H = config.hidden
    sides = [config.coarsest * extent / 2**level for level in range(L)]
    matrix = hash_matrix(np.asarray(gaussians.means), sides, config.table)

    def layer(inputs: int, outputs: int) -> np.ndarray:  # He et al. 2015
        return rng.normal(0, (2 / inputs) ** 0.5, (inputs, outputs))

    start = {
        "table": rng.uniform(-config.spread, config.spread, (L * config.table, F)),
        "first": layer(L * F, H),
        "second": layer(H, H),
        "last": np.zeros((H, 7)),
    }

    def motion(p):
        code = mi.TensorXf(sparse_product(matrix, p["table"]).array, (N, L * F))
        output = dr.maximum(dr.maximum(code @ p["first"], 0) @ p["second"], 0) @ p["last"]
        return output[:, :3] * (config.displacement * extent), output[:, 3:]

    rates = dict.fromkeys(start, config.rate) | {"table": config.table_rate}
    return MotionModel(
        {name: from_numpy(mi.TensorXf, value) for name, value in start.items()}, rates, motion
    )


@MOTION_MODELS.register("cache")
def _cache(argument: str, config: MotionConfig) -> MotionModelFactory:
    return lambda gaussians, extent, rng: transformation_cache(
        gaussians, extent, rng, CacheConfig()
    )


def hash_matrix(points: np.ndarray, sides: list[float], table: int) -> csr_array:
    """Return the weights of the entries of the tables at points, [N L, L T]; row n L + l reads
    level l of point n.

    Args:
        points: [N, 3], world units.
        sides: of the cells of each of L levels, world units.
        table: number T of entries of each table.
    """
    indices = []
    weights = []
    for level, side in enumerate(sides):
        corner, weight = corners(points, side)  # [N, 8, 3], [N, 8]
        hashed = np.bitwise_xor.reduce(corner.astype(np.uint64) * _PRIMES, axis=-1)
        indices.append((hashed % np.uint64(table)).astype(np.int64) + level * table)
        weights.append(weight)
    starts = np.arange(0, 8 * len(sides) * len(points) + 1, 8)
    columns = (np.stack(values, axis=1).ravel() for values in (weights, indices))
    return csr_array((*columns, starts), (len(points) * len(sides), len(sides) * table))

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

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array

from benchmarks.field.shared import corners
from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import (
    MOTION_MODELS,
    MotionModel,
    MotionModelFactory,
    sparse_product,
)

# Of the hash by Mueller et al.
_PRIMES = np.array([1, 2_654_435_761, 805_459_861], np.uint64)
# Side of the cells of the first of L levels, in scene extents; each further level halves it.
_COARSEST = 0.8
_LEVELS = 6
# Entries of each level's table, beyond which corners share entries, and numbers of an entry.
_TABLE = 4096
_FEATURES = 4
# Width of the two hidden layers.
_HIDDEN = 64
# Largest number of an entry at the start.
_SPREAD = 0.5
# Displacement for an output of 1, in scene extents.
_DISPLACEMENT = 0.1
# Learning rates at the start of the network's weights and of the tables; they fall to a tenth.
_RATE = 2e-3
_TABLE_RATE = 0.1


def transformation_cache(
    gaussians: Gaussians, extent: float, rng: np.random.Generator
) -> MotionModel:
    """Return the model of N Gaussians of the previous frame.

    Args:
        gaussians: of the previous frame, detached.
        extent: of the scene, world units.
        rng: draws the weights and the tables.
    """
    N = len(gaussians)
    matrix = hash_matrix(np.asarray(gaussians.means), extent)
    inputs = _LEVELS * _FEATURES

    def layer(inputs: int, outputs: int) -> np.ndarray:  # He et al. 2015
        return rng.normal(0, (2 / inputs) ** 0.5, (inputs, outputs))

    start = {
        "table": rng.uniform(-_SPREAD, _SPREAD, (_LEVELS * _TABLE, _FEATURES)),
        "first": layer(inputs, _HIDDEN),
        "second": layer(_HIDDEN, _HIDDEN),
        "last": np.zeros((_HIDDEN, 7)),
    }

    def motion(p):
        code = mi.TensorXf(sparse_product(matrix, p["table"]).array, (N, inputs))
        output = dr.maximum(dr.maximum(code @ p["first"], 0) @ p["second"], 0) @ p["last"]
        return output[:, :3] * (_DISPLACEMENT * extent), output[:, 3:]

    rates = dict.fromkeys(start, _RATE) | {"table": _TABLE_RATE}
    return MotionModel(
        {name: from_numpy(mi.TensorXf, value) for name, value in start.items()}, rates, motion
    )


@MOTION_MODELS.register("cache")
def _cache(argument: str, config: MotionConfig) -> MotionModelFactory:
    return transformation_cache


def hash_matrix(points: np.ndarray, extent: float) -> csr_array:
    """Return the weights of the entries of the tables at points [N, 3], [N L, L T]; row n L + l
    reads level l of point n. `extent` of the scene in world units.
    """
    indices = []
    weights = []
    for level in range(_LEVELS):
        corner, weight = corners(points, _COARSEST * extent / 2**level)  # [N, 8, 3], [N, 8]
        hashed = np.bitwise_xor.reduce(corner.astype(np.uint64) * _PRIMES, axis=-1)
        indices.append((hashed % np.uint64(_TABLE)).astype(np.int64) + level * _TABLE)
        weights.append(weight)
    starts = np.arange(0, 8 * _LEVELS * len(points) + 1, 8)
    columns = (np.stack(values, axis=1).ravel() for values in (weights, indices))
    return csr_array((*columns, starts), (len(points) * _LEVELS, _LEVELS * _TABLE))

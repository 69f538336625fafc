"""Local rigidity, after Dynamic 3D Gaussians (Luiten et al., 3DV 2024): neighbours move like parts
of one body.

For a Gaussian i and each of its k nearest neighbours j, with r_i the rotation of i since the
previous frame and e_ij = mu_j - mu_i then, e'_ij now,

    rigid     w_ij |e'_ij - r_i(e_ij)|        j keeps its place in the coordinate system of i,
    rotation  w_ij |r_j - r_i|                both turn alike (quaternions),
    isometry  w_ij ||e'_ij| - |e_ij||         their distance stays,

each a mean over all pairs, with w_ij = exp(-|e_ij|^2 / s^2). Lengths count in scene extents. The
three are terms of the objective, which `ObjectiveConfig.terms` selects by these names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Float, Jit, Tensor
from morgs_mi.method.cohesion import NeighbourIndex
from morgs_mi.method.motion_model import quaternion_product, sparse_product
from morgs_mi.method.objective import Loss, ObjectiveConfig, Observations, Prediction, loss_term

# Scene extents below which a length counts as 0: the derivative of a norm is infinite there.
_SHORT = 1e-6
# Neighbours k of each Gaussian, as in the publication.
_NEIGHBOURS = 20
# Distance s in scene extents at which the weight of a neighbour has fallen to 0.37.
_REACH = 0.1


@dataclass(frozen=True, eq=False)
class Neighbours:
    """E pairs (i, j) of N Gaussians as they were in the previous frame."""

    first: csr_array  #: matrix [E, N] that selects i.
    difference: csr_array  #: matrix [E, N] that subtracts the value of i from the value of j.
    weights: Float  #: w [E], divided by E.
    edges: Jit  #: e [3, E], scene extents.
    inverse: Jit  #: Inverse rotations, unit quaternions wxyz [4, N].
    extent: float  #: Of the scene, world units.


def find_neighbours(
    gaussians: Gaussians, extent: float, count: int = _NEIGHBOURS, reach: float = _REACH
) -> Neighbours:
    """Return the pairs of neighbours among N > 1 Gaussians of the previous frame.

    Args:
        gaussians: the N Gaussians.
        extent: of the scene, world units.
        count: number k of neighbours of each Gaussian.
        reach: distance s at which the weight of a neighbour has fallen to 0.37, in scene extents.
    """
    means = np.asarray(gaussians.means)
    near = NeighbourIndex(means).nearest(count)
    N, k = near.shape
    first = _selection(np.repeat(np.arange(N), k), N)
    edges = (means[near] - means[:, None]).reshape(-1, 3) / extent
    weights = np.exp(-np.sum(edges**2, axis=1) / reach**2) / len(edges)
    quats = np.asarray(gaussians.quats)
    squares = np.maximum(np.sum(quats**2, axis=1, keepdims=True), 1e-30)
    inverse = quats * (1, -1, -1, -1) / squares
    return Neighbours(
        first,
        csr_array(_selection(near.ravel(), N) - first),
        from_numpy(mi.Float, weights),
        mi.Vector3f(*(from_numpy(mi.Float, x) for x in edges.T)),
        mi.Vector4f(*(from_numpy(mi.Float, x) for x in inverse.T)),
        extent,
    )


# One entry: the previous Gaussians are one object in all steps, up to the round of density control.
@lru_cache(maxsize=1)
def _neighbours_of(previous: Gaussians, extent: float) -> Neighbours:
    return find_neighbours(previous, extent)


def _selection(indices: np.ndarray, N: int) -> csr_array:
    """Return the matrix [E, N] that selects the values of the Gaussians at `indices` [E]."""
    ones = np.ones(len(indices), np.float32)
    return csr_array((ones, (np.arange(len(indices)), indices)), (len(indices), N))


def rigid_loss(gaussians: Gaussians, neighbours: Neighbours) -> Tensor:
    """Return the mean of w_ij |e'_ij - r_i(e_ij)| over all pairs, a scalar tensor.

    Args:
        gaussians: N Gaussians now.
        neighbours: theirs in the previous frame.
    """
    r = _columns(sparse_product(neighbours.first, _turns(gaussians, neighbours)), 4)
    e = neighbours.edges
    u = mi.Vector3f(r.y, r.z, r.w)
    t = 2 * dr.cross(u, e)
    return _mean(
        _length(_edges(gaussians, neighbours) - (e + r.x * t + dr.cross(u, t))), neighbours
    )


def rotation_loss(gaussians: Gaussians, neighbours: Neighbours) -> Tensor:
    """Return the mean of w_ij |r_j - r_i| over all pairs, a scalar tensor; see `rigid_loss`."""
    return _mean(
        _length(_columns(sparse_product(neighbours.difference, _turns(gaussians, neighbours)), 4)),
        neighbours,
    )


def isometry_loss(gaussians: Gaussians, neighbours: Neighbours) -> Tensor:
    """Return the mean of w_ij ||e'_ij| - |e_ij|| over all pairs, a scalar; see `rigid_loss`."""
    change = _length(_edges(gaussians, neighbours)) - _length(neighbours.edges)
    return _mean(dr.abs(change), neighbours)


def _turns(gaussians: Gaussians, neighbours: Neighbours) -> Tensor:
    """Return the rotations r [N, 4] since the previous frame, unit quaternions wxyz."""
    rotations = dr.normalize(_columns(gaussians.quats, 4))
    unit = neighbours.inverse * dr.rcp(dr.norm(neighbours.inverse))
    turns: Jit = dr.ravel(quaternion_product(rotations, unit))
    return mi.TensorXf(turns, (len(gaussians), 4))


def _edges(gaussians: Gaussians, neighbours: Neighbours) -> Jit:
    return _columns(sparse_product(neighbours.difference, gaussians.means), 3) / neighbours.extent


def _columns(tensor: Tensor, width: int) -> Jit:
    return dr.unravel(mi.Vector3f if width == 3 else mi.Vector4f, tensor.array)


def _length(x: Jit) -> Float:
    return dr.sqrt(dr.squared_norm(x) + _SHORT**2)


def _mean(values: Float, neighbours: Neighbours) -> Tensor:
    return dr.sum(neighbours.weights * values)


LOSSES = {"rigid": rigid_loss, "rotation": rotation_loss, "isometry": isometry_loss}
"""Losses by the names of their terms."""


def _term(loss: Callable[[Gaussians, Neighbours], Tensor]) -> Loss:
    """Return a loss as a term; a Gaussian alone has no neighbours, so its loss is 0."""

    def term(prediction: Prediction, observations: Observations, config: ObjectiveConfig) -> Tensor:
        if len(prediction.previous) < 2:
            return dr.zeros(mi.Float)
        neighbours = _neighbours_of(prediction.previous, prediction.extent)
        return loss(prediction.gaussians, neighbours)

    return term


for _name, _loss in LOSSES.items():
    loss_term(_name)(_term(_loss))

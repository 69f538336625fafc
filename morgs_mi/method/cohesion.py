"""Cohesion: neighbours of similar colour are parts of one object, and move or stand still together.

Flow is unreliable evidence of motion. It is zero inside an object with weak texture, it bleeds onto
the background beside the object, and shadows have flow, too. But objects are mostly separate from
their surroundings in space or in colour. So the logit u_i of the confidence of each active Gaussian
is replaced by z_i, an approximate solution of

    z_i = (u_i + lambda sum_j a_ij z_j) / (1 + lambda sum_j a_ij),
    a_ij = o_j exp(-|c_i - c_j|^2 / (2 s^2)),

over its nearest neighbours j, where o is opacity and c is chromaticity, which shadows hardly
change. All other Gaussians stand still. (A random walk on the graph of neighbours; Grady 2006
segments images so.)

A Gaussian that resembles none of its neighbours follows its own evidence, and one that is
transparent does not pull others along: such Gaussians gather over many frames, and all of them seem
to stand still.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.neighbours import NeighbourIndex

# Of 1: the chromaticity of darker colours is noise.
_LEAST_COLOR = 0.02
# Number of nearest Gaussians: more of them would pull along thin objects of few Gaussians.
_NEIGHBOURS = 12
# Difference of chromaticity s at which the affinity has fallen to 0.61.
_CHROMA_SCALE = 0.03
# Rounds of averaging (Jacobi's method). With more of them, and a larger weight, evidence spreads
# farther.
ROUNDS = 150


def share_confidence(
    gaussians: Gaussians,
    indices: np.ndarray,
    logit: np.ndarray,
    still: float,
    weight: float,
    neighbours: NeighbourIndex | None = None,
) -> np.ndarray:
    """Return the logits z [M] of the chosen Gaussians (see the module).

    Args:
        gaussians: N Gaussians, detached.
        indices: int [M], indices of the active ones.
        logit: u [M], their own logits.
        still: logit of all others.
        weight: lambda, of an opaque neighbour of the same colour; 0: no cohesion.
        neighbours: index of all means; None: it is built.
    """
    neighbours = neighbours or NeighbourIndex(np.asarray(gaussians.means))
    near = neighbours.nearest_of(indices, _NEIGHBOURS)
    if not near.size:
        return logit
    affinity = weight * _affinity(gaussians, indices, near)
    starts = np.arange(0, near.size + 1, near.shape[1])
    weights = csr_array((affinity.ravel(), near.ravel(), starts), (len(indices), len(gaussians)))
    total = 1 + affinity.sum(axis=1)
    everywhere = np.full(len(gaussians), still, np.float32)
    everywhere[indices] = logit
    for _ in range(ROUNDS):
        everywhere[indices] = (logit + weights @ everywhere) / total
    return everywhere[indices]


def _affinity(gaussians: Gaussians, indices: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the affinities [M, k] of the Gaussians at `indices` [M] to neighbours [M, k]."""
    chroma = _chromaticity(gaussians)
    opacity = np.asarray(gaussians.opacities)
    square = np.sum((chroma[indices][:, None] - chroma[near]) ** 2, axis=2)
    return (opacity[near] * np.exp(-square / (2 * _CHROMA_SCALE**2))).astype(np.float32)


def _chromaticity(gaussians: Gaussians) -> np.ndarray:
    """Return the colours [N, 3] without view-dependence, each divided by its sum."""
    color = np.maximum(0.5 + SH_C0 * np.asarray(gaussians.sh_coeffs)[:, 0], _LEAST_COLOR)
    return color / color.sum(axis=1, keepdims=True)

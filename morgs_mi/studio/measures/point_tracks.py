"""Tracks of 3D points through a stream: a point moves with the Gaussians that dominate it.

The response of a Gaussian at a point x is o exp(-d^2 / 2), with its opacity o and the Mahalanobis
distance d of x from its mean. A query point x at frame q is bound to the K Gaussians of the largest
response at q, with weights w_k proportional to it. Each of them carries the point rigidly, with its
mean and its rotation:

    x_k(t) = mean_k(t) + R_k(t) R_k(q)^T (x - mean_k(q)),

and the track is the mean of the x_k(t), weighted by the w_k of the Gaussians that are alive at t,
forward and backward from q. With K = 1 this is the rule of Dynamic 3D Gaussians (Luiten et al.
2024). Where none of a point's Gaussians is alive, the point stays where it was and is marked as
lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from morgs_mi.codec.frame_source import FrameSource, FrameState
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import numbers
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import unit_quats

_MOST_ENTRIES = 2**24
# Floor of the scales, as a share of the distance of the farthest point or mean, so that a flat
# Gaussian has an inverse covariance that float64 can represent.
_FLATTEST = 1e-6
# A point counts as hidden if it lies behind the rendered depth by more than this share.
_DEPTH_TOLERANCE = 0.02


@dataclass(frozen=True)
class PointTracks:
    """Tracks of P points through T frames, each bound to at most K Gaussians.

    Attributes:
        frames: int64 [T], indices of the frames.
        points: float64 [P, T, 3], positions in world units.
        alive: bool [P, T], whether any of a point's Gaussians is alive; otherwise the point keeps
            its last position.
        ids: int64 [P, K], the Gaussians by falling response, unique in the whole stream; -1 for
            none.
        weights: float64 [P, K], their weights, which sum to 1.
    """

    frames: np.ndarray
    points: np.ndarray
    alive: np.ndarray
    ids: np.ndarray
    weights: np.ndarray


def track_points(
    stream: FrameSource,
    points: ArrayLike,
    frame: int | ArrayLike,
    num_gaussians: int = 8,
    progress: Callable[[int], None] | None = None,
) -> PointTracks:
    """Return the tracks of points on the surfaces of a scene, forward and backward from the frames
    of their queries.

    Args:
        stream: the file, which is read twice.
        points: query points [P, 3], world units.
        frame: the frame of each query, one for all or [P].
        num_gaussians: largest number of Gaussians to which a point is bound; 1: the one of the
            largest response.
        progress: called with the number of frames done.

    Example:
        >>> stream = morgs_mi.open_stream("out/arm_fit")
        >>> tracks = morgs_mi.track_points(stream, [(0.2, 0.5, 0.1)], frame=0)
        >>> print(tracks.points[0, -1], tracks.alive[0, -1])

    Raises:
        ValueError: an argument has another shape, a point is not finite, the stream has no such
            frame, or a packet is broken.
    """
    points = _checked_points(points)
    queries = _checked_frames(frame, len(points))
    if num_gaussians < 1:
        raise ValueError(
            f"track_points(): `num_gaussians` must be at least 1, got {num_gaussians}."
        )
    ids, weights, local = _bindings(stream, points, queries, num_gaussians)
    frames = []
    positions = []
    alive = []
    for t, total, mean in _carried(stream, ids, weights, local):
        positions.append(mean)
        alive.append(total > 0)
        frames.append(t)
        if progress is not None:
            progress(len(frames))
    order = np.asarray(frames)
    tracks = np.stack(positions, 1)
    living = np.stack(alive, 1)
    at_query = order == queries[:, None]
    tracks[at_query] = points
    return PointTracks(
        order, _held(tracks, living | at_query, order >= queries[:, None]), living, ids, weights
    )


def _checked_points(points: ArrayLike) -> np.ndarray:
    """Return the query points, float64 [P, 3]."""
    points = numbers("track_points()", "points", points).astype(np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(
            f"track_points(): `points` must be [P, 3] and finite, got {points.shape}; pass world "
            "points."
        )
    return points


def _checked_frames(frame: int | ArrayLike, count: int) -> np.ndarray:
    """Return the frame of each query [P]."""
    queries = np.asarray(frame)
    if queries.shape not in ((), (count,)) or queries.dtype.kind not in "iu":
        raise ValueError(
            f"track_points(): `frame` must be an integer or integers [{count}], got "
            f"{queries.dtype} {queries.shape}; pass the frame of each query."
        )
    return np.broadcast_to(queries, count)


def bind(
    gaussians: Gaussians, points: np.ndarray, num_gaussians: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gaussians of the largest response at each point [P, K] by falling response, and
    their weights.

    Args:
        gaussians: N Gaussians.
        points: [P, 3], world units.
        num_gaussians: K is this number, but at most N.
    """
    count = min(num_gaussians, len(gaussians))
    if not count or not len(points):
        return np.zeros((len(points), count), np.int64), np.zeros((len(points), count))
    center = gaussians.numpy()["means"].mean(0, dtype=np.float64)
    points = points - center
    polynomial = _log_responses(gaussians, center, np.abs(points).max())
    return _strongest(points, polynomial, count)


def _strongest(
    points: np.ndarray, polynomial: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the same as `bind` from the result of `_log_responses`."""
    rows = np.zeros((len(points), count), np.int64)
    weights = np.zeros((len(points), count))
    step = max(1, _MOST_ENTRIES // polynomial.shape[1])
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        rows[part], largest = _largest(_monomials(points[part]) @ polynomial, count)
        # Relative to the largest: far from all Gaussians every response underflows.
        weights[part] = np.exp(largest - largest[:, :1])
    return rows, weights / weights.sum(1, keepdims=True)


def _log_responses(gaussians: Gaussians, center: np.ndarray, farthest: float) -> np.ndarray:
    """Return the factors [10, N] of `_monomials` for the logarithm of each Gaussian's response.

    It is a quadratic polynomial in x, hence all of them are one matrix product.

    Args:
        gaussians: N Gaussians.
        center: origin [3] of the points.
        farthest: largest coordinate of a point.
    """
    raw = gaussians.numpy()
    means = raw["means"] - center
    inverse = _inverse_covariances(gaussians, max(np.abs(means).max(), farthest, 1e-30))
    moment = np.einsum("nij,nj->ni", inverse, means)
    log_opacity = -np.logaddexp(0, -raw["logit_opacities"].astype(np.float64))
    constant = log_opacity - 0.5 * np.einsum("ni,ni->n", moment, means)
    i, j = np.triu_indices(3)
    double = np.where(i == j, -0.5, -1.0)
    return np.vstack([(double * inverse[:, i, j]).T, moment.T, constant])


def _inverse_covariances(gaussians: Gaussians, size: float) -> np.ndarray:
    """Return the inverse covariances [N, 3, 3] in a scene of some size."""
    log_scales = gaussians.numpy()["log_scales"]
    scales = np.maximum(np.exp(log_scales.astype(np.float64)), _FLATTEST * size)
    axes = _rotations(unit_quats(gaussians)) / scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def _monomials(points: np.ndarray) -> np.ndarray:
    """Return the products of two coordinates, the coordinates and 1 at each point [P, 10]."""
    i, j = np.triu_indices(3)
    return np.hstack([points[:, i] * points[:, j], points, np.ones((len(points), 1))])


def _largest(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and the values [P, K] of the K largest ones in each row of `values`, which
    is overwritten.
    """
    every = np.arange(len(values))
    columns = np.zeros((len(values), count), np.int64)
    largest = np.zeros((len(values), count))
    for k in range(count):  # several times faster than a partition of the rows
        best = values.argmax(1)
        columns[:, k] = best
        largest[:, k] = values[every, best]
        values[every, best] = -np.inf
    return columns, largest


def seen_in_depth(
    depth: np.ndarray, alpha: np.ndarray, camera: Camera, points: np.ndarray
) -> np.ndarray:
    """Return the mask of the points [P] that a camera sees: inside its image, and not behind the
    rendered surface.

    A point is behind if it is farther by more than 2 % than the farthest rendered depth in the 3x3
    pixels around it; pixels with an alpha below 0.5 hide nothing.

    Args:
        depth: rendered depth [H, W], world units.
        alpha: rendered alpha [H, W].
        camera: the view.
        points: [P, 3], world units.
    """
    V = np.asarray(camera.viewmat, np.float64)
    z = points @ V[2, :3] + V[2, 3]
    front = np.flatnonzero(z > camera.near)
    pixels = np.floor(camera.project(points[front])[0])
    mask = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1)
    front = front[mask]
    farthest = _farthest_around(np.where(alpha < 0.5, np.inf, depth), pixels[mask].astype(int))
    visible = np.zeros(len(points), bool)
    visible[front] = z[front] <= (1 + _DEPTH_TOLERANCE) * farthest
    return visible


def _farthest_around(depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the largest depth [P] in the 3x3 pixels around each of `pixels` [P, 2]."""
    column, row = pixels.T
    surface = np.pad(depth, 1, mode="edge")
    return np.max(
        [surface[row + dy, column + dx] for dy in range(3) for dx in range(3)], axis=0, initial=0
    )


def _bindings(
    stream: FrameSource, points: np.ndarray, queries: np.ndarray, num_gaussians: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ids and weights [P, K] of the points' Gaussians, and the points in their axes
    [P, K, 3].
    """
    shape = len(points), num_gaussians
    ids = np.full(shape, -1)
    weights = np.zeros(shape)
    local = np.zeros((*shape, 3))
    last = int(queries.max(initial=-1))
    rest = set(queries.tolist())
    for state in stream.states():
        rest.discard(state.frame)
        rows = np.flatnonzero(queries == state.frame)
        if len(rows):
            parts = _binding(state, points[rows], num_gaussians)
            for array, part in zip((ids, weights, local), parts, strict=True):
                array[rows, : part.shape[1]] = part
        if state.frame >= last:
            break
    if rest:
        raise ValueError(
            f"track_points(): `frame` must be a frame of {stream.path}, got {min(rest)}; choose "
            "one that it contains."
        )
    return ids, weights, local


def _binding(
    state: FrameState, points: np.ndarray, num_gaussians: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the same as `_bindings` for points whose query is one frame; K as in `bind`."""
    rows, weights = bind(state.gaussians, points, num_gaussians)
    means, axes = _means_and_axes(state.gaussians, rows)
    local = np.einsum("pkji,pkj->pki", axes, points[:, None] - means)
    return state.lasting_ids[rows], weights, local


def _carried(
    stream: FrameSource, ids: np.ndarray, weights: np.ndarray, local: np.ndarray
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield (frame, total weight of the living [P], mean of the positions to which they carry each
    point [P, 3]); the other arguments are the results of `_bindings`.
    """
    for t, living_mask, (means, axes) in _bound(stream, ids):
        candidates = means + np.einsum("pkij,pkj->pki", axes, local)
        weight = weights * living_mask
        total = weight.sum(1, keepdims=True)
        share = weight / np.where(total > 0, total, 1)
        yield t, total[:, 0], np.einsum("pk,pki->pi", share, candidates)


def _bound(
    stream: FrameSource, ids: np.ndarray
) -> Iterator[tuple[int, np.ndarray, tuple[np.ndarray, np.ndarray]]]:
    """Yield (frame, mask of the living [P, K], their means [P, K, 3] and axes [P, K, 3, 3]) of the
    bound Gaussians.
    """
    for state in stream.states():
        rows, mask = _rows_of_ids(state.lasting_ids, ids)
        means = np.zeros((*ids.shape, 3))
        axes = np.zeros((*ids.shape, 3, 3))
        means[mask], axes[mask] = _means_and_axes(state.gaussians, rows[mask])
        yield state.frame, mask, (means, axes)


def _rows_of_ids(present: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where `ids` are among the ascending ids `present`, and the mask of those that are."""
    rows = np.searchsorted(present, ids)
    mask = rows < len(present)
    mask[mask] = present[rows[mask]] == ids[mask]
    return rows, mask


def _means_and_axes(gaussians: Gaussians, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means [..., 3] and axes [..., 3, 3] of the Gaussians at `rows` [...]."""
    means = gaussians.numpy()["means"].astype(np.float64)[rows]
    quats = unit_quats(gaussians)[rows].reshape(-1, 4)
    return means, _rotations(quats).reshape(*rows.shape, 3, 3)


def _rotations(quats: np.ndarray) -> np.ndarray:
    """Return the rotations [N, 3, 3] of unit quaternions [N, 4]."""
    return Rotation.from_quat(quats, scalar_first=True).as_matrix()


def _held(tracks: np.ndarray, known_mask: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return tracks [P, T, 3] that keep their last known position, in the direction away from the
    query.

    Args:
        tracks: positions [P, T, 3], meaningless where they are not known.
        known_mask: [P, T], true at each query.
        forward: [P, T], whether a frame is the query's or a later one.
    """
    time = np.arange(known_mask.shape[1])
    last_known = np.maximum.accumulate(np.where(known_mask, time, -1), axis=1)
    next_known = np.minimum.accumulate(np.where(known_mask, time, len(time))[:, ::-1], axis=1)[
        :, ::-1
    ]
    return np.take_along_axis(tracks, np.where(forward, last_known, next_known)[..., None], axis=1)

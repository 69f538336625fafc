"""Displacements in 3D of Gaussians on moving objects, compared with the objects' true trajectories.

d_i is the displacement of Gaussian i from frame t-1 to frame t, and d*_i the displacement of the
surface on which it lay at t-1:

1. A Gaussian lies on the surface of object k if, in some view at t-1, the pixel under its centre
   shows k within 1 % of the centre's depth, and the same holds for no other object in any view.
2. The motion of an object is the rigid motion that best maps its tracked points from t-1 to t,
   exact up to rounding. Objects that deform are excluded.
3. Gaussians are evaluated if their opacity is at least 0.1 and their d* is at least a tenth of the
   longest on their object: the others are hardly visible or have no meaningful direction.

The selection does not depend on d_i, so a Gaussian that left its object counts in full.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from morgs_mi.capture.truth import GroundTruth
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import seen_points
from morgs_mi.evaluate.results import Motion3DScores

_DEPTH_TOLERANCE = 0.01
_LEAST_OPACITY = 0.1
_LEAST_SHARE = 0.1
# Tolerances relative to an object's size: distance of tracked points from a rigid motion, and from
# one line.
_RIGID = 1e-4
_FLAT = 1e-3


def evaluate_motion(
    means: np.ndarray,
    displacements: np.ndarray,
    opacities: np.ndarray,
    tracks: tuple[np.ndarray, np.ndarray, np.ndarray],
    views: Sequence[tuple[Camera, GroundTruth]],
) -> Motion3DScores:
    """Return the errors of one frame's displacements; the module describes which Gaussians are
    evaluated.

    Args:
        means: centres at t-1 [N, 3], world units.
        displacements: from t-1 to t [N, 3].
        opacities: [N].
        tracks: the tracked points at t-1 and at t [P, 3], and their objects' ids [P].
        views: cameras with their ground truth at t-1.
    """
    ids = surface_ids(means, views)
    starts, ends, objects = tracks
    true = np.zeros_like(means, float)
    mask = np.zeros(len(means), bool)
    for index, (rotation, shift) in rigid_motions(starts, ends, objects).items():
        longest = np.linalg.norm(ends - starts, axis=-1)[objects == index].max()
        on = (ids == index) & (opacities >= _LEAST_OPACITY)
        true[on] = means[on] @ (rotation - np.eye(3)).T + shift
        mask |= on & (np.linalg.norm(true, axis=-1) >= _LEAST_SHARE * longest)
    return compare_motion(displacements[mask], true[mask])


def compare_motion(motion: np.ndarray, truth: np.ndarray) -> Motion3DScores:
    """Return the errors of displacements [M, 3] for true ones [M, 3], none of which is 0; NaN if M
    is 0.
    """
    if not len(truth):
        return Motion3DScores(num_gaussians=0)
    length = np.linalg.norm(motion, axis=-1)
    true_length = np.linalg.norm(truth, axis=-1)
    error = np.linalg.norm(motion - truth, axis=-1)
    cosine = (motion * truth).sum(-1) / np.where(length > 0, length * true_length, 1)
    return Motion3DScores(
        num_gaussians=len(truth),
        error=float(error.mean()),
        true_length=float(true_length.mean()),
        relative_error=float(error.mean() / true_length.mean()),
        length_ratio=float(length.mean() / true_length.mean()),
        angle=float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).mean()),
    )


def surface_ids(points: np.ndarray, views: Sequence[tuple[Camera, GroundTruth]]) -> np.ndarray:
    """Return the id of the object with each point [N, 3] on its visible surface; -1 for none or
    several.
    """
    ids = np.full(len(points), -1, np.int64)
    several = np.zeros(len(points), bool)
    for camera, truth in views:
        visible, pixels, depths = seen_points(camera, points)
        column, row = pixels.astype(int).T
        distances = np.abs(truth.depth[row, column] - depths)
        on = (truth.ids[row, column] >= 0) & (distances <= _DEPTH_TOLERANCE * depths)
        rows = np.flatnonzero(visible)[on]
        pixel_ids = truth.ids[row, column][on]
        several[rows] |= (ids[rows] >= 0) & (ids[rows] != pixel_ids)
        ids[rows] = pixel_ids
    ids[several] = -1
    return ids


def rigid_motions(
    starts: np.ndarray, ends: np.ndarray, ids: np.ndarray
) -> Mapping[int, tuple[np.ndarray, np.ndarray]]:
    """Return rotation [3, 3] and shift [3] of every moving object by its id: x -> R x + s.

    Least squares over the object's points (Kabsch 1976). Excluded are objects that are static or
    not rigid, and those with too few points or with all points on one line.

    Args:
        starts: tracked points [P, 3].
        ends: the same points one frame later.
        ids: ids of their objects [P].
    """
    motions: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for index in np.unique(ids):
        p = starts[ids == index]
        q = ends[ids == index]
        if np.array_equal(p, q) or len(p) < 3:
            continue
        center = p.mean(0)
        target = q.mean(0)
        size = np.linalg.norm(p - center, axis=-1).max()
        # The rotation that maps p best to q, both around their means.
        U, spread, Vt = np.linalg.svd((q - target).T @ (p - center) / len(p))
        U[:, 2] *= np.linalg.det(U @ Vt)
        rotation = U @ Vt
        shift = target - rotation @ center
        off = np.linalg.norm(p @ rotation.T + shift - q, axis=-1).max()
        if spread[1] > (_FLAT * size) ** 2 and off <= _RIGID * size:
            motions[int(index)] = (rotation, shift)
    return motions

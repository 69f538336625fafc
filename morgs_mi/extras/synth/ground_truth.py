"""Exact ground truth of a clip: motion, depth, object ids and motion masks.

A surface point x_t of a rigid object with pose M_t was at x_{t-1} = M_{t-1} M_t^{-1} x_t. With pi
the projection, the motion map of frame t is pi(x_t) - pi(x_{t-1}) at each pixel of frame t.

On disk: ``truth/cam00/0000.exr`` holds one camera's frame, ``truth/tracks.npz`` the clip's
trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.capture.truth import GroundTruth
from morgs_mi.core.camera import Camera


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the objects of a scene at one time."""

    positions: np.ndarray  #: [..., 3], world units; undefined where the id is negative.
    ids: np.ndarray  #: Object id [...]; -1 where there is no surface, or a lamp.

    def reshaped(self, *shape: int) -> SurfacePoints:
        """Return the points in another shape."""
        return SurfacePoints(self.positions.reshape(*shape, 3), self.ids.reshape(shape))

    def pick(self, pixels: np.ndarray) -> SurfacePoints:
        """Return the points of the pixels with these indices [P] in row-major order."""
        flat = self.reshaped(self.ids.size)
        return SurfacePoints(flat.positions[pixels], flat.ids[pixels])


def move_with_objects(
    surface: SurfacePoints, poses: np.ndarray, new_poses: np.ndarray
) -> np.ndarray:
    """Return the positions [..., 3] of surface points after the motion of their objects.

    Points that do not move are returned bit for bit.

    Args:
        surface: points on the objects at `poses`.
        poses: object-to-world of the objects [O, 4, 4], by their ids.
        new_poses: the same after the motion.
    """
    positions = surface.positions.copy()
    for moving in np.flatnonzero((poses != new_poses).any(axis=(1, 2))):
        points = surface.ids == moving
        motion = new_poses[moving] @ np.linalg.inv(poses[moving])
        positions[points] = surface.positions[points] @ motion[:3, :3].T + motion[:3, 3]
    return positions


def compute_ground_truth(
    camera: Camera,
    surface: SurfacePoints,
    poses: np.ndarray,
    before: np.ndarray | None,
    after: np.ndarray,
) -> GroundTruth:
    """Return the ground truth of a frame from the surface points at its pixel centres.

    Args:
        camera: the view.
        surface: the points [H, W].
        poses: object-to-world of the objects in this frame [O, 4, 4], by their ids.
        before: the same in the previous frame; None in the first frame.
        after: the same in the next frame, which determines the mask of the first frame.
    """
    # A point in front of the camera where there is no surface avoids a division by zero; its values
    # are not used.
    front = camera.position + camera.rotation[2]
    points = np.where((surface.ids >= 0)[..., None], surface.positions, front)
    pixels, depth = camera.project(points)
    other = move_with_objects(
        replace(surface, positions=points), poses, after if before is None else before
    )
    motion = np.zeros_like(pixels) if before is None else pixels - camera.project(other)[0]
    # Coordinates are single-precision: motion below their rounding error counts as zero.
    mask = np.linalg.norm(other - points, axis=-1) > 1e-6 * np.abs(points).max()
    return GroundTruth(
        motion.astype(np.float32),
        np.where(surface.ids >= 0, depth, 0).astype(np.float32),
        surface.ids.astype(np.int32),
        mask,
    )

"""Exact ground truth of a clip: motion, depth, object ids and motion masks.

A surface point x_t of a rigid object with pose M_t was at x_{t-1} = M_{t-1} M_t^{-1} x_t. A point of a deforming
object has barycentric coordinates b_i in a triangle, and x_t - x_{t-1} = sum_i b_i (v_{i,t} - v_{i,t-1}) with its
vertices v_i. With pi the projection, the motion map of frame t is pi(x_t) - pi(x_{t-1}) at each pixel of frame t.

On disk: ``truth/cam00/0000.exr`` holds one camera's frame, ``truth/tracks.npz`` the clip's trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.capture.truth import GroundTruth
from morgs_mi.core.camera import Camera
from morgs_mi.synth.scene import Deformed

__all__ = [
    "SurfacePoints",
    "compute_ground_truth",
    "move_with_objects",
]


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the objects of a scene at one time.

    Attributes:
        positions: [..., 3], world units; undefined where the id is negative.
        ids: object id [...]; -1 where there is no surface, or a lamp.
        corners: indices of the three vertices around a point of a deforming object [..., 3].
        weights: barycentric coordinates of the point [..., 3].
    """

    positions: np.ndarray
    ids: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    @classmethod
    def rigid(cls, positions: np.ndarray, ids: np.ndarray) -> SurfacePoints:
        """Return points of rigid objects."""
        return cls(positions, ids, np.zeros(positions.shape, np.int64), np.zeros(positions.shape))

    def reshaped(self, *shape: int) -> SurfacePoints:
        """Return the points in another shape."""
        vectors = (values.reshape(*shape, 3) for values in (self.corners, self.weights))
        return SurfacePoints(self.positions.reshape(*shape, 3), self.ids.reshape(shape), *vectors)

    def pick(self, pixels: np.ndarray) -> SurfacePoints:
        """Return the points of the pixels with these indices [P] in row-major order."""
        flat = self.reshaped(self.ids.size)
        return SurfacePoints(flat.positions[pixels], flat.ids[pixels], flat.corners[pixels], flat.weights[pixels])


# Per object: its pose [4, 4], or the vertices of a deforming object.
Poses = Sequence[np.ndarray | Deformed]


def move_with_objects(surface: SurfacePoints, poses: Poses, new_poses: Poses) -> np.ndarray:
    """Return the positions [..., 3] of surface points after the motion of their objects.

    Points that do not move are returned bit for bit.

    Args:
        surface: points on the objects at `poses`.
        poses: object-to-world [4, 4] of each object, or its vertices.
        new_poses: the same after the motion.
    """
    moved = surface.positions.copy()
    for index, (pose, new_pose) in enumerate(zip(poses, new_poses, strict=True)):
        own = surface.ids == index
        if isinstance(pose, Deformed) and isinstance(new_pose, Deformed):
            corners = new_pose.vertices[surface.corners[own]] - pose.vertices[surface.corners[own]]
            moved[own] += (surface.weights[own][..., None] * corners).sum(axis=-2)
        elif not (isinstance(pose, Deformed) or isinstance(new_pose, Deformed) or np.array_equal(pose, new_pose)):
            motion = new_pose @ np.linalg.inv(pose)
            moved[own] = surface.positions[own] @ motion[:3, :3].T + motion[:3, 3]
    return moved


def compute_ground_truth(
    camera: Camera, surface: SurfacePoints, poses: Poses, before: Poses | None, after: Poses
) -> GroundTruth:
    """Return the ground truth of a frame from the surface points at its pixel centres.

    Args:
        camera: the view.
        surface: the points [H, W].
        poses: object-to-world [4, 4] of each object in this frame, or its vertices.
        before: the same in the previous frame; None in the first frame.
        after: the same in the next frame, which determines the mask of the first frame.
    """
    hit = surface.ids >= 0
    # Where there is no surface, a point in front of the camera avoids a division by zero; its values are not used.
    points = np.where(hit[..., None], surface.positions, camera.position + np.asarray(camera.viewmat)[2, :3])
    pixels, depth = camera.project(points)
    other = move_with_objects(replace(surface, positions=points), poses, after if before is None else before)
    motion = np.zeros_like(pixels) if before is None else pixels - camera.project(other)[0]
    # Coordinates are single-precision: motion below their rounding error counts as zero.
    mask = np.linalg.norm(other - points, axis=-1) > 1e-6 * np.abs(points).max()
    return GroundTruth(
        motion.astype(np.float32), np.where(hit, depth, 0).astype(np.float32), surface.ids.astype(np.int32), mask
    )

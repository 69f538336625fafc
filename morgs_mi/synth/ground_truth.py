"""Exact ground truth of a clip whose objects are rigid: what moved, by how much, and how far away it is.

A surface point x_t of an object with pose M_t was at x_{t-1} = M_{t-1} M_t^{-1} x_t. With pi the projection,
the motion map of frame t is pi(x_t) - pi(x_{t-1}) at each pixel of frame t: where each pixel came from.

On disk: ``truth/cam00/0000.exr`` holds one camera's frame, ``truth/tracks.npz`` the clip's trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.io.exr import read_exr, write_exr

__all__ = ["GroundTruth", "Tracks", "carry", "ground_truth_of", "load_tracks", "load_truth", "project", "save_truth"]


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth on one camera's frame t.

    Attributes:
        motion: x_t - x_{t-1} in pixels [H, W, 2]; zero in frame 0.
        depth: along the camera's z axis, world units [H, W]; 0 where the pixel sees nothing.
        ids: object id [H, W], int32; -1 where the pixel sees nothing.
        mask: whether the surface point moved in the world since t-1 (in frame 0: until frame 1) [H, W], bool.
    """

    motion: np.ndarray
    depth: np.ndarray
    ids: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class Tracks:
    """Exact trajectories of surface points.

    Attributes:
        points: positions at each frame [P, T, 3], world units.
        ids: object id of each point [P], int32.
    """

    points: np.ndarray
    ids: np.ndarray


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel positions [..., 2] and the depths [...] of world points [..., 3]."""
    V = np.asarray(camera.viewmat, float)
    local = points @ V[:3, :3].T + V[:3, 3]
    return (local @ camera.K.T)[..., :2] / local[..., 2:], local[..., 2]


def carry(points: np.ndarray, ids: np.ndarray, poses: Sequence[np.ndarray], to: Sequence[np.ndarray]) -> np.ndarray:
    """Return where world points [..., 3] of objects `ids` [...] go when the objects leave `poses` for `to`.

    What does not move keeps its coordinates to the bit.
    """
    carried = points.copy()
    for index, (here, there) in enumerate(zip(poses, to, strict=True)):
        if not np.array_equal(here, there):
            motion = there @ np.linalg.inv(here)
            own = ids == index
            carried[own] = points[own] @ motion[:3, :3].T + motion[:3, 3]
    return carried


def ground_truth_of(
    camera: Camera,
    points: np.ndarray,
    ids: np.ndarray,
    poses: Sequence[np.ndarray],
    before: Sequence[np.ndarray] | None,
    after: Sequence[np.ndarray],
) -> GroundTruth:
    """Return the truth on a frame whose pixel centres see `points` [H, W, 3] of objects `ids` [H, W].

    Args:
        camera: the view.
        points: world units; ignored where the id is negative.
        ids: index into the poses, or -1.
        poses: object-to-world [4, 4] of each object now.
        before: the same one frame ago; None in the first frame.
        after: the same one frame later, which decides the mask of the first frame.
    """
    hit = ids >= 0
    # Any point in front of the camera will do where there is no surface: nothing is kept of it.
    points = np.where(hit[..., None], points, camera.position + np.asarray(camera.viewmat)[2, :3])
    pixels, depth = project(camera, points)
    other = carry(points, ids, poses, after if before is None else before)
    motion = np.zeros_like(pixels) if before is None else pixels - project(camera, other)[0]
    # Coordinates are single-precision: what moves less than their rounding stands still.
    mask = np.linalg.norm(other - points, axis=-1) > 1e-6 * np.abs(points).max()
    return GroundTruth(
        motion.astype(np.float32), np.where(hit, depth, 0).astype(np.float32), ids.astype(np.int32), mask
    )


def save_truth(folder: str | Path, camera: str, frame: int, truth: GroundTruth) -> None:
    """Write one camera's frame as ``folder/camera/0000.exr``.

    Raises:
        OSError: if it cannot be written.
    """
    path = _path(folder, camera, frame)
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {
        "motion.X": truth.motion[..., 0],
        "motion.Y": truth.motion[..., 1],
        "depth.Y": truth.depth,
        "id.Y": truth.ids,
        "mask.Y": truth.mask,
    }
    write_exr(path, channels)


def load_truth(folder: str | Path, camera: str, frame: int) -> GroundTruth:
    """Read the ground truth of a camera's frame from a capture's ``truth`` folder.

    Raises:
        FileNotFoundError: if the folder has no such camera or frame.
        OSError: if the file is damaged.
        ValueError: if a channel is missing.
    """
    path = _path(folder, camera, frame)
    channels = read_exr(path)
    missing = {"motion.X", "motion.Y", "depth.Y", "id.Y", "mask.Y"} - set(channels)
    if missing:
        raise ValueError(f"load_truth(): {path} lacks the channels {sorted(missing)}; synthesize the capture again.")
    return GroundTruth(
        np.stack([channels["motion.X"], channels["motion.Y"]], axis=-1),
        channels["depth.Y"],
        channels["id.Y"].astype(np.int32),
        channels["mask.Y"] > 0.5,
    )


def load_tracks(folder: str | Path) -> Tracks:
    """Read the trajectories from a capture's ``truth`` folder.

    Raises:
        FileNotFoundError: if the folder has none.
    """
    path = Path(folder) / "tracks.npz"
    if not path.is_file():
        raise FileNotFoundError(f"load_tracks(): there is no file {path}; give a synthetic capture's truth folder.")
    with np.load(path) as arrays:
        return Tracks(arrays["points"], arrays["ids"])


def _path(folder: str | Path, camera: str, frame: int) -> Path:
    return Path(folder) / camera / f"{frame:04d}.exr"

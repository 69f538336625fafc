"""Ground truth of a capture: exact motion, depth and masks of its frames, and tracks of surface
points.

On disk: ``truth/cam00/0000.exr`` has one camera's frame, ``truth/tracks.npz`` the trajectories of
the clip.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.io.exr import read_exr, write_exr
from morgs_mi.io.listing import existing_file
from morgs_mi.platform.bounded import array_names, read_array


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of one camera's frame t.

    Attributes:
        motion: x_t - x_{t-1} in pixels [H, W, 2]; zero in frame 0.
        depth: along the camera's z axis, world units [H, W]; 0 where there is no surface.
        ids: object id [H, W], int32; -1 where there is no surface.
        mask: whether the surface point moved in the world since t-1 (in frame 0: until frame 1)
            [H, W], bool.
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
        visible: by camera name, whether the camera sees each point at each frame [P, T], bool;
            empty if unknown.
    """

    points: np.ndarray
    ids: np.ndarray
    visible: Mapping[str, np.ndarray] = field(default_factory=dict)


def save_truth(folder: str | Path, camera: str, frame: int, truth: GroundTruth) -> None:
    """Write the ground truth of one camera's frame as ``folder/camera/0000.exr``.

    Raises:
        OSError: the file cannot be written.
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
        FileNotFoundError: the folder has no such camera or frame.
        OSError: the file is damaged.
        ValueError: a channel is missing.
    """
    path = _path(folder, camera, frame)
    channels = read_exr(path)
    try:
        return GroundTruth(
            np.stack([channels["motion.X"], channels["motion.Y"]], axis=-1),
            channels["depth.Y"],
            channels["id.Y"].astype(np.int32),
            channels["mask.Y"] > 0.5,
        )
    except KeyError as error:
        raise ValueError(f"{path}: expected a channel {error}; synthesise it again.") from None


def load_tracks(folder: str | Path) -> Tracks:
    """Read the trajectories from a capture's ``truth`` folder.

    Raises:
        FileNotFoundError: the folder has none.
        ValueError: the file is broken.
    """
    path = existing_file(
        Path(folder) / "tracks.npz", "the tracks of a synthetic capture", "pass its truth folder"
    )
    prefix = "visible_"
    names = [name.removeprefix(prefix) for name in array_names(path) if name.startswith(prefix)]
    return Tracks(
        read_array(path, "points"),
        read_array(path, "ids"),
        {name: read_array(path, prefix + name) for name in names},
    )


def save_tracks(folder: str | Path, tracks: Tracks) -> None:
    """Write the trajectories into a capture's ``truth`` folder.

    Raises:
        OSError: the file cannot be written.
    """
    arrays: dict[str, Any] = {f"visible_{name}": mask for name, mask in tracks.visible.items()}
    np.savez_compressed(Path(folder) / "tracks.npz", points=tracks.points, ids=tracks.ids, **arrays)


def _path(folder: str | Path, camera: str, frame: int) -> Path:
    return Path(folder) / camera / f"{frame:04d}.exr"

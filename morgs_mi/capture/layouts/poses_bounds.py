"""`poses_bounds.npy`, the calibration of LLFF and of Neural 3D Video (N3DV).

One row [17] per camera, in the order of the existing videos by number: a 3x5 matrix in row-major
order with the columns down, right and backward axis of the camera, its centre (all in the world)
and (height, width, focal length); then the nearest and farthest depth, which are not used. The
principal point is the image centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from morgs_mi.capture.layouts.calibration import CalibratedView, Calibration, Reader, required_clips
from morgs_mi.capture.layouts.clips import check_frames, clips_by_frame
from morgs_mi.core.camera import Camera, intrinsic_matrix, pose_at, rigid
from morgs_mi.platform.bounded import read_array
from morgs_mi.platform.checks import errors_at


def read_poses_bounds(path: str | Path, names: Sequence[str]) -> tuple[Camera, ...]:
    """Return one camera per name.

    Args:
        path: the file.
        names: names of the cameras, in the order of the rows.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a NumPy array [C, 17] with one row per name, or a row is not a valid
            pose.
    """
    rows = read_array(path)
    if rows.shape[1:] != (17,) or rows.dtype.kind != "f":
        raise ValueError(f"{path}: expected a float array [C, 17], got {rows.dtype} {rows.shape}.")
    if len(rows) != len(names):
        raise ValueError(
            f"{path}: expected one row per camera, got {len(rows)} rows for {len(names)} videos "
            f"({', '.join(names)}); remove the rows of missing videos."
        )
    cameras = []
    for i, (row, name) in enumerate(zip(rows.astype(np.float64), names, strict=True)):
        # Poses of any numbers become NaN or infinite without a warning, and are then refused.
        with errors_at(f"{path}, row {i} ({name})"), np.errstate(all="ignore"):
            down, right, back, centre, (height, width, focal) = row[:15].reshape(3, 5).T
            pose = pose_at(np.stack([right, down, -back]), centre)
            viewmat = rigid("columns in the order down, right, back", pose)
            K = intrinsic_matrix(focal, focal, 0.5 * width, 0.5 * height)
            cameras.append(Camera(K, viewmat, round(width), round(height), name))
    return tuple(cameras)


def _read_calibration(path: Path) -> Calibration:
    """Match the rows to the clips: a folder per camera or, if their number fits better, a folder
    per frame.
    """
    source = path / "poses_bounds.npy"
    clips = required_clips(path)
    count = read_array(source).shape[:1]
    if (len(clips),) != count == (len(by_frame := clips_by_frame(path)),):
        check_frames(path, next(iter(by_frame.values())))
        clips = by_frame
    cameras = read_poses_bounds(source, list(clips))
    views = (CalibratedView(camera, clip=clips[camera.name]) for camera in cameras)
    return Calibration(tuple(views))


READER = Reader(
    "poses_bounds",
    ("poses_bounds.npy",),
    lambda path: (path / "poses_bounds.npy").is_file(),
    _read_calibration,
    poses=None,
)

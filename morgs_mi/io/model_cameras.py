"""Cameras of a training run of 3D Gaussian Splatting, from the `cameras.json` in the folder of its
model.

A model has `cameras.json` and `point_cloud/iteration_30000/point_cloud.ply`. The file is a list of
objects with `img_name`, `width`, `height`, `position` [3], `rotation` [3][3] (camera to world, x
right, y down, z forward), `fx` and `fy` in pixels; the principal point is the middle of the image.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morgs_mi.core.bounded import read_json
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import errors_at
from morgs_mi.io.unread import warn_unread

_KEYS = {"width", "height", "position", "rotation", "fx", "fy"}
_HARMLESS = {"id", "img_name", "image_name", "name", "near", "far"}
# Cameras that are kept, evenly spaced in the file: more are of no use to a viewer.
_MOST = 48


def model_cameras(path: Path) -> tuple[Path | None, tuple[Camera, ...]]:
    """Return the `cameras.json` that may belong to a file of Gaussians, and its cameras; None and
    none without one.

    The file is beside the Gaussians or in one of the two folders above. At most 48 cameras are
    returned. Nothing in it names the Gaussians: it may be of another scene.

    Raises:
        ValueError: an entry is broken.
    """
    for folder in path.resolve().parents[:3]:
        file = folder / "cameras.json"
        rows = read_json(file) if file.is_file() else None
        if not rows or not isinstance(rows, list):
            continue
        if not all(isinstance(row, dict) and row.keys() >= _KEYS for row in rows):
            continue
        warn_unread(file, {key for row in rows for key in row} - _KEYS - _HARMLESS)
        cameras = []
        for i in range(0, len(rows), -(-len(rows) // _MOST)):
            row = rows[i]
            with errors_at(f"{file}: entry {i}: expected a camera, got a broken one"):
                R = np.asarray(row["rotation"], np.float64)
                viewmat = np.eye(4)
                viewmat[:3, :3] = R.T
                viewmat[:3, 3] = -R.T @ np.asarray(row["position"], np.float64)
                width, height, fx, fy = (float(row[key]) for key in ("width", "height", "fx", "fy"))
                K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
                name = str(row.get("img_name", i))
                cameras.append(Camera(K, viewmat, round(width), round(height), name))
        return file, tuple(cameras)
    return None, ()

"""Nerfstudio's `transforms.json`: poses as camera -> world with OpenGL's axes.

Each of its `frames` names a file and has a `transform_matrix` [4, 4]: camera -> world, x right, y up, z backward.
Intrinsics (`fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`) and lens coefficients are keys of the file or of a frame; the frame's
take precedence. Pixel centres lie at +0.5, as in `Camera`. World units are the units of the matrices:
`applied_transform` and `applied_scale` are not undone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.layouts.calibration import (
    NO_POINTS,
    Calibration,
    Layout,
    PoseConvention,
    match_clips,
    required_clips,
)
from morgs_mi.capture.lens import Lens, opencv_lens
from morgs_mi.core.camera import Camera, rigid
from morgs_mi.core.checks import LARGEST, bounded
from morgs_mi.io.bounded import read_json
from morgs_mi.io.ply import read_vertices

__all__ = ["LAYOUT", "read_points_ply", "read_transforms"]

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
# Nerfstudio treats all of these as its single perspective model.
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")


def read_transforms(path: Path) -> tuple[list[Camera], list[Lens], Path | None]:
    """Return the cameras, named by their `file_path`, their lenses, and the path of the points' PLY file or None.

    Raises:
        ValueError: the file is broken, a key is missing or not a number, a pose is not rigid, or the camera model is
            not supported.
    """
    meta = read_json(path)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise ValueError(f"{path}: expected an object with a list of `frames`, got none; export it again.")
    cameras, lenses = [], []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise ValueError(f"{where}: `file_path` must name a file, got {name!r}; export it again.")
        where += f" ({name})"
        values = meta | frame
        cameras.append(_camera(where, values, name))
        lenses.append(_lens(where, values))
    points = meta.get("ply_file_path")
    return cameras, lenses, path.parent / points if points else None


def _camera(where: str, values: Mapping[str, Any], name: str) -> Camera:
    width, height = (_number(where, values, key) for key in ("w", "h"))
    if "fl_x" not in values and "camera_angle_x" in values:
        angle = _number(where, values, "camera_angle_x")
        fx = 0.5 * width / np.tan(0.5 * angle)
    else:
        fx = _number(where, values, "fl_x")
    fy = _number(where, values, "fl_y", fx)
    cx, cy = _number(where, values, "cx", width / 2), _number(where, values, "cy", height / 2)
    try:
        matrix = np.array(values.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    to_world = rigid(where, matrix)
    viewmat = np.linalg.inv(to_world @ _OPENGL_FROM_OPENCV)
    try:
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), viewmat, round(width), round(height), name)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _lens(where: str, values: Mapping[str, Any]) -> Lens:
    model = values.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (_number(where, values, key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        return Lens(model, (k1, k2, k3, k4))
    if model not in _PERSPECTIVE:
        raise ValueError(
            f"{where}: `camera_model` must be OPENCV_FISHEYE or one of {', '.join(_PERSPECTIVE)}, got {model!r}; "
            "undistort the images first."
        )
    if k4:
        # Nerfstudio's k4 is the coefficient of r^8, for which COLMAP has no model. OpenCV's k4 is in the denominator.
        raise ValueError(f"{where}: `k4` must be 0 in a perspective camera, got {k4}; undistort the images first.")
    return opencv_lens((k1, k2, p1, p2, k3))


def _number(where: str, values: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= LARGEST:
        got = "none" if value is None else repr(value)[:80]
        raise ValueError(
            f"{where}: `{key}` must be a finite number of at most {LARGEST:g}, here or at the top of the file, got "
            f"{got}."
        )
    return float(value)


def read_points_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions [P, 3] and colours [P, 3] in [0, 1] of a point cloud; grey if the file has no colours.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a PLY file with vertices x, y, z, or they are not finite.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected the points' PLY file, found none; copy it or drop `ply_file_path`.")
    vertices = read_vertices(path)
    if missing := {"x", "y", "z"} - vertices.keys():
        raise ValueError(
            f"{path}: expected a PLY file with vertices x, y, z, got vertices without {', '.join(sorted(missing))}; "
            "export it again."
        )
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float32)
    if not bounded(points):
        raise ValueError(f"{path}: the points must be finite and at most {LARGEST:g}, got others; export them again.")
    if not {"red", "green", "blue"} <= vertices.keys():
        return points, np.full(points.shape, 0.5, np.float32)
    colors = np.stack([vertices[band] for band in ("red", "green", "blue")], axis=1)
    scale = 255 if colors.dtype.kind in "iu" else 1
    return points, colors.astype(np.float32) / np.float32(scale)


def _read_calibration(path: Path) -> Calibration:
    clips, source = required_clips(path), path / "transforms.json"
    cameras, lenses, ply = read_transforms(source)
    points, colors = read_points_ply(ply) if ply else (NO_POINTS, NO_POINTS)
    return Calibration(*match_clips(path, source, clips, cameras, lenses), points, colors)


LAYOUT = Layout(
    "Nerfstudio",
    ("transforms.json",),
    lambda path: (path / "transforms.json").is_file(),
    _read_calibration,
    PoseConvention("camera to world", "OpenGL"),
)

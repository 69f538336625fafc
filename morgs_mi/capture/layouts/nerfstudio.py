"""Nerfstudio's `transforms.json`, and `transforms_train.json` and `transforms_test.json` of NeRF's
synthetic scenes: poses as camera -> world with OpenGL's axes.

Each of its `frames` names a file and has a `transform_matrix` [4, 4]: camera -> world, x right, y
up, z backward. Intrinsics (`fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`), lens coefficients and `mask_path`
are keys of the file or of a frame; the frame's take precedence. `w` and `h` may be missing. Pixel
centres lie at +0.5, as in `Camera`. World units are the units of the matrices: `applied_transform`
and `applied_scale` are not undone. Of the two files, the second has the held-out images.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from morgs_mi.capture.layouts.calibration import (
    CalibratedImage,
    Calibration,
    PoseConvention,
    Reader,
    match_clips,
    required_clips,
)
from morgs_mi.capture.layouts.clips import size_of_clip
from morgs_mi.capture.lens import Lens, opencv_lens
from morgs_mi.core.camera import Camera, intrinsic_matrix, rigid
from morgs_mi.io.clip_readers import Clip
from morgs_mi.io.listing import existing_file
from morgs_mi.io.ply import columns_of, read_vertices
from morgs_mi.platform.bounded import JsonObject, read_json, warn_unread
from morgs_mi.platform.checks import check_number, errors_at, few, numbers, require

_LOG = logging.getLogger(__name__)

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
# Nerfstudio treats all of these as its single perspective model.
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_INTRINSICS = {"w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y"}
_BANDS = ("red", "green", "blue")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_KEYS = {
    *_INTRINSICS,
    *_DISTORTION,
    "frames",
    "time",
    "file_path",
    "transform_matrix",
    "ply_file_path",
    "mask_path",
    "camera_model",
    "is_fisheye",
}
# Keys of exporters that say nothing about the cameras: instant-ngp's, Nerfstudio's, Blender's and
# Record3D's.
_HARMLESS = {
    "aabb_scale",
    "aabb",
    "scale",
    "offset",
    "up",
    "render_aabb",
    "n_extra_learnable_dims",
    "from_na",
    "sharpness",
    "enable_depth_loading",
    "enable_ray_loading",
    "integer_depth_scale",
    "depth_unit_scale_factor",
    "depth_path",
    "applied_transform",
    "applied_scale",
    "orientation_override",
    "auto_scale_poses_override",
    "colmap_im_id",
    "colmap_camera_id",
    "colmap_img_id",
    "depth_file_path",
    "normal_file_path",
    "timestamp",
    "rotation",
    "near",
    "far",
    "description",
    "version",
    "date",
}


@dataclass(frozen=True)
class _Image(CalibratedImage):
    """One entry of `frames`."""

    time: str = ""


def _place(name: Any) -> PurePosixPath:
    """Return the place of a file that a value names, relative to the capture."""
    return PurePosixPath(str(name).replace("\\", "/"))


def _number(
    where: str,
    values: JsonObject,
    key: str,
    default: float | None = None,
    interval: str = "[-1e12, 1e12]",
) -> float:
    value = values.get(key, default)
    check_number(where, key, value, interval)
    return value


def _camera(where: str, values: JsonObject, name: str) -> Camera:
    width = _number(where, values, "w")
    height = _number(where, values, "h")
    fx = _focal_length(where, values, "x", width)
    fy = _focal_length(where, values, "y", height, fx)
    cx = _number(where, values, "cx", width / 2)
    cy = _number(where, values, "cy", height / 2)
    K = intrinsic_matrix(fx, fy, cx, cy)
    matrix = numbers(where, "transform_matrix", values.get("transform_matrix", []))
    pose = rigid(f"{where}: `transform_matrix`", matrix)
    with errors_at(where):
        viewmat = np.linalg.inv(pose @ _OPENGL_FROM_OPENCV)
        return Camera(K, viewmat, round(width), round(height), name)


def _focal_length(
    where: str, values: JsonObject, axis: str, size: float, default: float | None = None
) -> float:
    """Return the focal length from `fl_x` or `camera_angle_x`, px, of an axis along which the image
    has `size` px.
    """
    key = f"fl_{axis}"
    angle = f"camera_angle_{axis}"
    if key not in values and angle in values:
        return 0.5 * size / math.tan(0.5 * _number(where, values, angle, interval="(0, 3.14159)"))
    return _number(where, values, key, default)


def _lens(where: str, values: JsonObject) -> Lens:
    model = values.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (_number(where, values, key, 0.0) for key in _DISTORTION)
    if values.get("is_fisheye") or model == "OPENCV_FISHEYE":
        return Lens("OPENCV_FISHEYE", (k1, k2, k3, k4))
    # Nerfstudio's k4 is the coefficient of r^8, for which COLMAP has no model. OpenCV's k4 is in
    # the denominator.
    require(
        model in _PERSPECTIVE and k4 == 0,
        where,
        "`camera_model` must be OPENCV_FISHEYE, or with a `k4` of 0 one of "
        f"{', '.join(_PERSPECTIVE)}",
        f"{model!r} with {k4:g}",
        "undistort the images first",
    )
    return opencv_lens((k1, k2, p1, p2, k3))


def read_points_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions [P, 3] and colours [P, 3] in [0, 1] of a point cloud; grey if the file
    has no colours.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a PLY file with vertices x, y, z.
    """
    existing_file(path, "the points' PLY file", "copy it or drop `ply_file_path`")
    vertices = read_vertices(path)
    if missing := set("xyz") - vertices.keys():
        raise ValueError(
            f"{path}: expected vertices x, y, z, got no {', '.join(missing)}; export it again."
        )
    points = columns_of(vertices, "xyz")
    if not {*_BANDS} <= vertices.keys():
        return points, np.full(points.shape, 0.5, np.float32)
    colors = columns_of(vertices, _BANDS)
    scale = 255 if colors.dtype.kind in "iu" else 1
    return points, colors.astype(np.float32) / np.float32(scale)


def _sources(path: Path) -> list[Path]:
    """Return the calibration of a capture, and the file of the held-out cameras if there is one."""
    train = path / "transforms_train.json"
    # Converters that split their images also write all of them to `transforms.json`.
    files = (
        [train, path / "transforms_test.json"] if train.is_file() else [path / "transforms.json"]
    )
    return list(filter(Path.is_file, files))


def _read_images(
    path: Path, source: Path, clips: Mapping[str, Clip]
) -> tuple[JsonObject, list[_Image]]:
    """Return the content of a file, and the images of its `frames`."""
    meta = read_json(source)
    require(
        isinstance(meta, dict), source, "expected an object", repr(meta)[:80], "export it again"
    )
    frames = meta.get("frames")
    require(
        isinstance(frames, list) and {*map(type, frames)} <= {dict},
        source,
        "`frames` must be a list of objects",
        repr(frames)[:80],
        "export it again",
    )
    keys = set().union(meta, *frames)
    if frames and not {"w", "h"} <= keys:
        meta["w"], meta["h"] = size_of_clip(next(iter(clips.values())))
    warn_unread(source, keys - _KEYS - _HARMLESS)
    images = []
    for index, frame in enumerate(frames):
        values = meta | frame
        where = f"{source}, frame {index}"
        name = values.get("file_path")
        require(
            isinstance(name, str) and name,
            where,
            "`file_path` must name a file",
            repr(name),
            "export it again",
        )
        where = f"{where} ({name})"
        mask = values.get("mask_path")
        masks = (path / _place(mask),) if mask else ()
        camera = _camera(where, values, name)
        images.append(_Image(camera, _lens(where, values), masks, time=str(values.get("time"))))
    return meta, images


def _read_calibration(path: Path) -> Calibration:
    clips = required_clips(path)
    source, *others = _sources(path)
    if unread := sorted({*path.glob("transforms*.json")} - {source, *others}):
        _LOG.warning("%s: not used: %s.", path, few([file.name for file in unread]))
    meta, images = _read_images(path, source, clips)
    names = {image.name for image in images}
    for other in others:
        images += _read_images(path, other, clips)[1]
    require(
        images, source, "`frames` must have an entry for each camera", "none", "export it again"
    )
    calibration = match_clips(path, source, clips, images)
    times = {image.time for image in images}
    num_images = len(calibration.views[0].images)
    require(
        len(times) <= num_images,
        source,
        f"`time` must have as many values as each camera has images, {num_images}, because "
        "cameras are fixed",
        len(times),
        "record by fixed cameras, or remove `time` if nothing moves",
    )
    if others:
        held_out = tuple(
            view.name
            for view in calibration.views
            if names.isdisjoint(image.name for image in view.images)
        )
        calibration = replace(calibration, held_out=held_out)
    if file := meta.get("ply_file_path"):
        points, colors = read_points_ply(path / _place(file))
        calibration = replace(calibration, points=points, point_colors=colors)
    return calibration


READER = Reader(
    "Nerfstudio",
    ("transforms.json", "transforms_train.json"),
    lambda path: bool(_sources(path)),
    _read_calibration,
    PoseConvention("camera to world", "OpenGL"),
)

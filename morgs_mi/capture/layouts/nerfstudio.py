"""Nerfstudio's `transforms.json`: poses as camera -> world with OpenGL's axes.

Each of its `frames` names a file and has a `transform_matrix` [4, 4]: camera -> world, x right, y
up, z backward. Intrinsics (`fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`), lens coefficients and `mask_path`
are keys of the file or of a frame; the frame's take precedence. `w` and `h` may be missing. Pixel
centres lie at +0.5, as in `Camera`. World units are the units of the matrices: `applied_transform`
and `applied_scale` are not undone. `train_filenames`, `val_filenames` and `test_filenames` split
the images.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from morgs_mi.capture.layouts.calibration import (
    NO_POINTS,
    Calibration,
    PoseConvention,
    Reader,
    match_clips,
    required_clips,
)
from morgs_mi.capture.layouts.clips import clip_of_image, size_of_clip
from morgs_mi.capture.lens import Lens, opencv_lens
from morgs_mi.core.bounded import read_json, warn_unread
from morgs_mi.core.camera import Camera, intrinsic_matrix, rigid
from morgs_mi.core.checks import LARGEST, errors_at
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, VIDEO_SUFFIXES, existing_file
from morgs_mi.io.ply import read_vertices

_LOG = logging.getLogger(__name__)

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
# Nerfstudio treats all of these as its single perspective model.
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_INTRINSICS = {"w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y"}
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")
_KEYS = {
    *_INTRINSICS,
    *_DISTORTION,
    *_SPLITS,
    "frames",
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
    "time",
    "rotation",
    "near",
    "far",
    "description",
    "version",
    "date",
}

# Kinds of values: their test, and in words.
_Kind = tuple[Callable[[Any], bool], str]
_NUMBER: _Kind = (
    lambda value: type(value) in (int, float) and abs(value) <= LARGEST,
    f"be a finite number of at most {LARGEST:g}, here or at the top of the file",
)
_FILE: _Kind = (lambda value: value is None or isinstance(value, str), "name a file")
_NAMES: _Kind = (lambda value: value is None or _is_list(value, str), "be a list of names")
_KINDS: dict[str, _Kind] = {
    "frames": (lambda value: value != [] and _is_list(value, dict), "be a list of objects"),
    "file_path": (lambda value: value != "" and isinstance(value, str), "name a file"),
    "is_fisheye": (lambda value: value in (True, False), "be true or false"),
    "mask_path": _FILE,
    "ply_file_path": _FILE,
    **dict.fromkeys(_SPLITS, _NAMES),
}


def _beside(path: Path, name: str | None) -> Path | None:
    """Return the file that the file `path` names, or None."""
    return path.parent / name.replace("\\", "/") if name else None


def _is_list(value: Any, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(entry, kind) for entry in value)


def _value(values: Mapping[str, Any], key: str, default: Any = None) -> Any:
    """Return a value of the file, of the kind that its key has."""
    value = values.get(key, default)
    is_kind, kind = _KINDS.get(key, _NUMBER)
    if not is_kind(value):
        raise ValueError(f"`{key}` must {kind}, got {repr(value)[:80]}; export it again.")
    return value


def _camera(values: Mapping[str, Any], name: str) -> Camera:
    width = _value(values, "w")
    height = _value(values, "h")
    fx = _focal_length(values, "x", width)
    fy = _focal_length(values, "y", height, fx)
    cx = _value(values, "cx", width / 2)
    cy = _value(values, "cy", height / 2)
    K = intrinsic_matrix(fx, fy, cx, cy)
    pose = rigid("`transform_matrix`", np.array(values.get("transform_matrix"), np.float64))
    return Camera(K, np.linalg.inv(pose @ _OPENGL_FROM_OPENCV), round(width), round(height), name)


def _focal_length(
    values: Mapping[str, Any], axis: str, size: float, default: float | None = None
) -> float:
    """Return the focal length from `fl_x` or `camera_angle_x`, px, of an axis along which the image
    has `size` px.
    """
    key = f"fl_{axis}"
    angle = f"camera_angle_{axis}"
    if key not in values and angle in values:
        return float(0.5 * size / np.tan(0.5 * _value(values, angle)))
    return _value(values, key, default)


def _lens(values: Mapping[str, Any]) -> Lens:
    model = values.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (_value(values, key, 0.0) for key in _DISTORTION)
    if _value(values, "is_fisheye", False) or model == "OPENCV_FISHEYE":
        return Lens("OPENCV_FISHEYE", (k1, k2, k3, k4))
    # Nerfstudio's k4 is the coefficient of r^8, for which COLMAP has no model. OpenCV's k4 is in
    # the denominator.
    if model not in _PERSPECTIVE or k4:
        raise ValueError(
            f"`camera_model` must be OPENCV_FISHEYE, or with a `k4` of 0 one of "
            f"{', '.join(_PERSPECTIVE)}, got {model!r} with {k4:g}; undistort the images first."
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
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    if not {"red", "green", "blue"} <= vertices.keys():
        return points, np.full(points.shape, 0.5, np.float32)
    colors = np.stack([vertices[band] for band in ("red", "green", "blue")], axis=1)
    scale = 255 if colors.dtype.kind in "iu" else 1
    return points, colors.astype(np.float32) / np.float32(scale)


def _read_calibration(path: Path) -> Calibration:
    clips = required_clips(path)
    source = path / "transforms.json"
    meta = read_json(source)
    meta = meta if isinstance(meta, dict) else {}
    with errors_at(source):
        frames = _value(meta, "frames")
        points_file = _beside(source, _value(meta, "ply_file_path"))
        splits = {split: names for split in _SPLITS if (names := _value(meta, split)) is not None}
    cameras = []
    lenses = []
    masks = []
    size_of = cache(size_of_clip)  # many images may be in one clip
    unread = {key for values in (meta, *frames) for key in values} - _KEYS - _HARMLESS
    for index, frame in enumerate(frames):
        values = meta | frame
        with errors_at(f"{source}, frame {index}"):
            name = _value(values, "file_path")
        if not {"w", "h"} <= values.keys():
            # Of another image if it is missing: its camera is left out later.
            names = [name, *(str(other.get("file_path")) for other in frames)]
            file = next(filter(None, (clip_of_image(path, each, clips) for each in names)), None)
            values |= zip(("w", "h"), () if file is None else size_of(file), strict=False)
        with errors_at(f"{source}, frame {index} ({name})"):
            cameras.append(_camera(values, name))
            lenses.append(_lens(values))
            masks.append(_beside(source, _value(values, "mask_path")))
        if lenses[-1].model == "OPENCV_FISHEYE":  # it has k1 to k4 alone
            unread |= {f"{key} of a fisheye" for key in ("p1", "p2") if values.get(key)}
    warn_unread(source, unread)
    points, colors = read_points_ply(points_file) if points_file else (NO_POINTS, NO_POINTS)
    calibration, images = match_clips(path, source, clips, cameras, lenses)
    clip_masks = tuple(
        tuple(dict.fromkeys(file for index in indices if (file := masks[index])))
        for indices in images
    )
    calibration = replace(
        calibration,
        points=points,
        point_colors=colors,
        masks=clip_masks if any(clip_masks) else calibration.masks,
    )
    if not splits:
        return calibration
    # A camera is trained on if one of its images is: is in `train_filenames` or, without these, in
    # no other split.
    indices = _images_named(source, splits, [camera.name for camera in cameras])
    held_out = indices.get("val_filenames", set()) | indices.get("test_filenames", set())
    training = indices.get("train_filenames", set(range(len(cameras))) - held_out)
    views = tuple(view for view, indices in enumerate(images) if training.isdisjoint(indices))
    if len(views) == len(images):
        raise ValueError(
            f"{source}: expected a camera to train on, got none in the splits; add one to the "
            "training split."
        )
    calibration = replace(calibration, test_views=views)
    if extras := [calibration.names[view] for view in views if held_out.isdisjoint(images[view])]:
        _LOG.warning("%s: %s in none of the splits: left out.", source, ", ".join(extras))
    return calibration.without(path, extras)


def _images_named(
    source: Path, splits: Mapping[str, Sequence[str]], names: Sequence[str]
) -> dict[str, set[int]]:
    """Return the indices of the images `names` in each split, which names them in full or by the
    end of one path alone.
    """
    places = list(map(_parts, names))
    images: dict[str, set[int]] = {}
    for split, split_names in splits.items():
        images[split] = set()
        unknown = []
        for name in split_names:
            parts = _parts(name)
            ends = {i for i, place in enumerate(places) if place[-len(parts) :] == parts}
            whole = {i for i in ends if places[i] == parts}
            if not whole and len(ends) != 1:
                unknown.append(name)
            else:
                images[split] |= whole or ends
        if unknown:
            _LOG.warning(
                "%s: `%s` names %d images without a frame, such as %s.",
                source,
                split,
                len(unknown),
                unknown[0],
            )
    return images


def _parts(name: str) -> tuple[str, ...]:
    """Return the parts of an image's path without the suffix of its format."""
    place = PurePosixPath(name.replace("\\", "/"))
    has_suffix = place.suffix.lower() in (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES, EXR_SUFFIX)
    return (place.with_suffix("") if has_suffix else place).parts


READER = Reader(
    "Nerfstudio",
    ("transforms.json",),
    lambda path: (path / "transforms.json").is_file(),
    _read_calibration,
    PoseConvention("camera to world", "OpenGL"),
)

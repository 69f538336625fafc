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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from morgs_mi.capture.layouts.clips import ImageSizes
from morgs_mi.capture.lens import Lens, opencv_lens
from morgs_mi.core.bounded import read_json
from morgs_mi.core.camera import Camera, rigid
from morgs_mi.core.checks import LARGEST, bounded
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, VIDEO_SUFFIXES
from morgs_mi.io.ply import read_vertices
from morgs_mi.io.unread import warn_unread
from morgs_mi.io.video import Clip

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


@dataclass(frozen=True)
class Transforms:
    """Content of a `transforms.json`."""

    cameras: list[Camera]  #: One per frame, named by its `file_path`.
    lenses: list[Lens]  #: One per frame.
    masks: list[Path | None]  #: Per frame the image whose black pixels are not used, or None.
    points: Path | None  #: The points' PLY file, or None.
    #: Names of images by split; empty if the file does not split them.
    splits: Mapping[str, list[str]]


def read_transforms(path: Path, clips: Mapping[str, Clip] | None = None) -> Transforms:
    """Return the content of a `transforms.json`.

    Args:
        path: the file.
        clips: clips by name, whose sizes frames without `w` and `h` have if their images are no
            files.

    Raises:
        ValueError: the file is broken, a key is missing or not a number, a pose is not rigid, or
            the camera model is not supported.
    """
    meta = read_json(path)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not frames or not _is_list(frames, dict):
        raise ValueError(
            f"{path}: expected an object with a list of `frames`, got none; export it again."
        )
    sizes = ImageSizes(path.parent, clips or {})
    cameras = []
    lenses = []
    masks = []
    for index, frame in enumerate(frames):
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise ValueError(
                f"{path}, frame {index}: `file_path` must name a file, got {name!r}; export it "
                "again."
            )
        where = f"{path}, frame {index} ({name})"
        values = meta | frame
        if not {"w", "h"} <= values.keys():
            # Of another image if it is missing: its camera is left out later.
            names = [name, *(str(other.get("file_path")) for other in frames)]
            size = next(filter(None, map(sizes.of, names)), ())
            values |= zip(("w", "h"), size, strict=False)
        cameras.append(_camera(where, values, name))
        lenses.append(_lens(where, values))
        masks.append(_file(path, where, values, "mask_path"))
    points = _file(path, str(path), meta, "ply_file_path")
    unread = {key for values in (meta, *frames) for key in values} - _KEYS - _HARMLESS
    for frame, lens in zip(frames, lenses, strict=True):
        if lens.model == "OPENCV_FISHEYE":  # it has k1 to k4 alone
            values = meta | frame
            unread |= {f"{key} of a fisheye" for key in ("p1", "p2") if values.get(key)}
    warn_unread(path, unread)
    splits = {split: meta[split] for split in _SPLITS if meta.get(split) is not None}
    for split, names in splits.items():
        if not _is_list(names, str):
            raise ValueError(
                f"{path}: `{split}` must be a list of names of images, got another value; correct "
                "it."
            )
    return Transforms(cameras, lenses, masks, points, splits)


def _is_list(value: Any, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(entry, kind) for entry in value)


def _file(path: Path, where: str, values: Mapping[str, Any], key: str) -> Path | None:
    """Return the file that a value names, relative to the file `path`, or None."""
    name = values.get(key)
    if name is not None and not isinstance(name, str):
        raise ValueError(
            f"{where}: `{key}` must name a file, got {repr(name)[:80]}; export it again."
        )
    return path.parent / name.replace("\\", "/") if name else None


def _camera(where: str, values: Mapping[str, Any], name: str) -> Camera:
    width = _number(where, values, "w")
    height = _number(where, values, "h")
    fx = _focal_length(where, values, "x", width)
    fy = _focal_length(where, values, "y", height, fx)
    cx = _number(where, values, "cx", width / 2)
    cy = _number(where, values, "cy", height / 2)
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    try:
        matrix = np.array(values.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    viewmat = np.linalg.inv(rigid(where, matrix) @ _OPENGL_FROM_OPENCV)
    try:
        return Camera(K, viewmat, round(width), round(height), name)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _focal_length(
    where: str, values: Mapping[str, Any], axis: str, size: float, default: float | None = None
) -> float:
    """Return the focal length from `fl_x` or `camera_angle_x`, px, of an axis along which the image
    has `size` px.
    """
    key = f"fl_{axis}"
    angle = f"camera_angle_{axis}"
    if key not in values and angle in values:
        return float(0.5 * size / np.tan(0.5 * _number(where, values, angle)))
    return _number(where, values, key, default)


def _lens(where: str, values: Mapping[str, Any]) -> Lens:
    model = values.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (_number(where, values, key, 0.0) for key in _DISTORTION)
    fisheye = values.get("is_fisheye", False)
    if fisheye not in (True, False):
        raise ValueError(
            f"{where}: `is_fisheye` must be true or false, got {repr(fisheye)[:80]}; correct it."
        )
    if fisheye or model == "OPENCV_FISHEYE":
        return Lens("OPENCV_FISHEYE", (k1, k2, k3, k4))
    if model not in _PERSPECTIVE:
        raise ValueError(
            f"{where}: `camera_model` must be OPENCV_FISHEYE or one of {', '.join(_PERSPECTIVE)}, "
            f"got {model!r}; undistort the images first."
        )
    if k4:
        # Nerfstudio's k4 is the coefficient of r^8, for which COLMAP has no model. OpenCV's k4 is
        # in the denominator.
        raise ValueError(
            f"{where}: `k4` must be 0 in a perspective camera, got {k4}; undistort the images "
            "first."
        )
    return opencv_lens((k1, k2, p1, p2, k3))


def _number(where: str, values: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= LARGEST:
        got = "none" if value is None else repr(value)[:80]
        raise ValueError(
            f"{where}: `{key}` must be a finite number of at most {LARGEST:g}, here or at the top "
            f"of the file, got {got}."
        )
    return float(value)


def read_points_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions [P, 3] and colours [P, 3] in [0, 1] of a point cloud; grey if the file
    has no colours.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a PLY file with vertices x, y, z, or they are not finite.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: expected the points' PLY file, found none; copy it or drop `ply_file_path`."
        )
    vertices = read_vertices(path)
    if missing := set("xyz") - vertices.keys():
        raise ValueError(
            f"{path}: expected a PLY file with vertices x, y, z, got vertices without "
            f"{', '.join(sorted(missing))}; export it again."
        )
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    if not bounded(points):
        raise ValueError(
            f"{path}: the points must be finite and at most {LARGEST:g}, got others; export them "
            "again."
        )
    if not {"red", "green", "blue"} <= vertices.keys():
        return points, np.full(points.shape, 0.5, np.float32)
    colors = np.stack([vertices[band] for band in ("red", "green", "blue")], axis=1)
    scale = 255 if colors.dtype.kind in "iu" else 1
    return points, colors.astype(np.float32) / np.float32(scale)


def _read_calibration(path: Path) -> Calibration:
    clips = required_clips(path)
    source = path / "transforms.json"
    content = read_transforms(source, clips)
    points, colors = read_points_ply(content.points) if content.points else (NO_POINTS, NO_POINTS)
    match = match_clips(path, source, clips, content.cameras, content.lenses)
    masks = tuple(
        tuple(dict.fromkeys(file for index in images if (file := content.masks[index])))
        for images in match.images
    )
    masks = masks if any(masks) else match.calibration.masks
    calibration = replace(match.calibration, points=points, point_colors=colors, masks=masks)
    return (
        _split(path, source, calibration, content, match.images) if content.splits else calibration
    )


def _split(
    path: Path,
    source: Path,
    calibration: Calibration,
    content: Transforms,
    images: Sequence[Sequence[int]],
) -> Calibration:
    """Return the calibration with the held-out cameras of `content`, and without those that are in
    no split.

    A camera is trained on if one of its images is: is in `train_filenames` or, without these, in no
    other split.

    Raises:
        ValueError: no camera is left for training.
    """
    names = [camera.name for camera in content.cameras]
    splits = {
        split: _images_named(source, split, split_names, names)
        for split, split_names in content.splits.items()
    }
    held_out = splits.get("val_filenames", set()) | splits.get("test_filenames", set())
    training = splits.get("train_filenames", set(range(len(names))) - held_out)
    views = tuple(view for view, indices in enumerate(images) if training.isdisjoint(indices))
    if len(views) == len(images):
        raise ValueError(
            f"{source}: expected a camera to train on, got none in `train_filenames`; correct the "
            "splits."
        )
    calibration = replace(calibration, test_views=views)
    if extras := [calibration.names[view] for view in views if held_out.isdisjoint(images[view])]:
        _LOG.warning("%s: %s in none of the splits: left out.", source, ", ".join(extras))
    return calibration.without(path, extras)


def _images_named(
    source: Path, split: str, split_names: Sequence[str], names: Sequence[str]
) -> set[int]:
    """Return the indices of the images `names` that a split names, in full or by the end of one
    path alone.
    """
    whole: dict[tuple[str, ...], set[int]] = {}
    ends: dict[tuple[str, ...], set[int]] = {}
    for index, parts in enumerate(map(_parts, names)):
        whole.setdefault(parts, set()).add(index)
        for start in range(1, len(parts)):
            ends.setdefault(parts[start:], set()).add(index)
    indices = {end: same for end, same in ends.items() if len(same) == 1} | whole
    if unknown := [name for name in split_names if _parts(name) not in indices]:
        _LOG.warning(
            "%s: `%s` names %d images without a frame, such as %s.",
            source,
            split,
            len(unknown),
            unknown[0],
        )
    return set().union(*(indices.get(_parts(name), set()) for name in split_names))


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

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
from morgs_mi.core.checks import LARGEST, errors_at
from morgs_mi.io.listing import EXR_SUFFIX, IMAGE_SUFFIXES, VIDEO_SUFFIXES, existing_file
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
    meta = meta if isinstance(meta, dict) else {}
    with errors_at(str(path)):
        frames = _value(meta, "frames")
        points = _value(meta, "ply_file_path")
        splits = {split: _value(meta, split) for split in _SPLITS}
    sizes = ImageSizes(path.parent, clips or {})
    cameras = []
    lenses = []
    masks = []
    unread = {key for values in (meta, *frames) for key in values} - _KEYS - _HARMLESS
    for index, frame in enumerate(frames):
        values = meta | frame
        with errors_at(f"{path}, frame {index}"):
            name = _value(values, "file_path")
        if not {"w", "h"} <= values.keys():
            # Of another image if it is missing: its camera is left out later.
            names = [name, *(str(other.get("file_path")) for other in frames)]
            size = next(filter(None, map(sizes.of, names)), ())
            values |= zip(("w", "h"), size, strict=False)
        with errors_at(f"{path}, frame {index} ({name})"):
            cameras.append(_camera(values, name))
            lenses.append(_lens(values))
            masks.append(_beside(path, _value(values, "mask_path")))
        if lenses[-1].model == "OPENCV_FISHEYE":  # it has k1 to k4 alone
            unread |= {f"{key} of a fisheye" for key in ("p1", "p2") if values.get(key)}
    warn_unread(path, unread)
    splits = {split: names for split, names in splits.items() if names is not None}
    return Transforms(cameras, lenses, masks, _beside(path, points), splits)


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
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
    pose = rigid("`transform_matrix`", np.array(values.get("transform_matrix"), np.float64))
    viewmat = np.linalg.inv(pose @ _OPENGL_FROM_OPENCV)
    return Camera(K, viewmat, round(width), round(height), name)


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
    content = read_transforms(source, clips)
    points, colors = read_points_ply(content.points) if content.points else (NO_POINTS, NO_POINTS)
    calibration, images = match_clips(path, source, clips, content.cameras, content.lenses)
    masks = tuple(
        tuple(dict.fromkeys(file for index in indices if (file := content.masks[index])))
        for indices in images
    )
    masks = masks if any(masks) else calibration.masks
    calibration = replace(calibration, points=points, point_colors=colors, masks=masks)
    return _split(path, source, calibration, content, images) if content.splits else calibration


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
            f"{source}: expected a camera to train on, got none in the splits; add one to the "
            "training split."
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

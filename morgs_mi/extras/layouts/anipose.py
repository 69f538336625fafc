"""Calibrations in Anipose's TOML format, which Pose2Sim, caliscope and FreeMoCap also write.

A table per camera (``[cam_0]``, or nested as ``[cameras.0]``) has ``name``, ``size`` [w, h],
``matrix`` [3, 3], ``distortions`` in OpenCV's order (k1 k2 p1 p2 k3, or k1 to k4 if ``fisheye`` is
true), ``rotation`` (Rodrigues vector or matrix) and ``translation``: world -> camera with OpenCV's
axes. Tables without any of these, such as ``[metadata]``, are not read. Cameras with
``ignore = true``, which caliscope writes, are left out. OpenCV puts pixel centres at integers, so
the principal point is shifted by half a pixel.

World units are the units of the file, which does not state them: millimetres or the units of the
calibration board for Anipose and FreeMoCap, metres for Pose2Sim and caliscope.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.capture.layouts.calibration import (
    CalibratedImage,
    Reader,
    calibration_files,
    only_calibration,
)
from morgs_mi.capture.lens import Lens, opencv_lens
from morgs_mi.core.camera import Camera, rigid
from morgs_mi.platform.bounded import MAX_TOML, read_text, read_toml, warn_unread
from morgs_mi.platform.checks import LARGEST, bounded, errors_at, few, require

_LOG = logging.getLogger(__name__)

_KEYS = ("matrix", "distortions", "rotation", "translation")
_CAMERA = {*_KEYS, "name", "size", "fisheye", "ignore"}
# Entries of caliscope, FreeMoCap and Pose2Sim that say nothing about the lenses and poses.
_HARMLESS = {
    "cam_id",
    "port",
    "error",
    "exposure",
    "grid_count",
    "rotation_count",
    "verified_resolutions",
    "metadata",
    "capture_volume",
    "charuco",
    "aruco",
    "board",
    "point_estimates",
    "camera_count",
    "creation_date",
    "save_tracked_points_video",
    "fps_recording",
    "fps_sync_stream_processing",
    "version",
}
# Pose2Sim names a camera after the folder of its checkerboard images, int_cam01_img.
_FOLDER = re.compile(r"^int_(.+)_img$")
# Recognises a calibration without parsing it; a broken one is then reported as a broken
# calibration.
_MARK = re.compile(r"^[ \t]*matrix[ \t]*=", re.MULTILINE)


def read_anipose(path: Path) -> list[CalibratedImage]:
    """Return the cameras that are not ignored, named as in the file.

    Raises:
        ValueError: the file is broken, a key of a camera is missing or has another form, or a
            rotation is none.
    """
    content = read_toml(path)
    nested = content.get("cameras")
    tables = nested if isinstance(nested, dict) else content
    entries = {
        key: table
        for key, table in tables.items()
        if isinstance(table, dict) and table.keys() & {*_KEYS}
    }
    ignored = [key for key, entry in entries.items() if entry.get("ignore")]
    require(
        len(ignored) < len(entries),
        path,
        f"expected a table for each camera, such as [cam_0], with {', '.join(_KEYS)}, and without "
        "`ignore = true`",
        "none",
        "export the calibration again",
    )
    keys = (content.keys() | tables.keys()) - entries.keys() - {"cameras"}
    warn_unread(path, keys.union(*entries.values()) - _CAMERA - _HARMLESS)
    if ignored:
        _LOG.warning("%s: tables with `ignore = true` are left out: %s.", path, few(ignored))
    return [_camera(path, key, entry) for key, entry in entries.items() if key not in ignored]


def _camera(path: Path, key: str, entry: Mapping[str, Any]) -> CalibratedImage:
    where = f"{path}, table [{key}]"
    name = entry.get("name", key if key.startswith("cam") else f"cam_{key}")
    require(
        isinstance(name, str | int) and name != "",
        where,
        "`name` must be a text",
        shortened(name),
        "name the camera as its clip",
    )
    size = _array(where, entry, "size", (2,))
    require(
        (size % 1 == 0).all(),
        where,
        "`size` must be whole pixels [w, h]",
        entry["size"],
        "calibrate again",
    )
    K = _array(where, entry, "matrix", (3, 3)).copy()
    K[:2, 2] += 0.5
    rotation = _array(where, entry, "rotation", (3,), (3, 3))
    if rotation.shape == (3,):
        rotation = Rotation.from_rotvec(rotation).as_matrix()
    viewmat = rigid(where, np.column_stack([rotation, _array(where, entry, "translation", (3,))]))
    with errors_at(where):
        width, height = size.astype(int).tolist()
        camera = Camera(K, viewmat, width, height, _FOLDER.sub(r"\1", str(name)))
    is_fisheye = entry.get("fisheye", False)
    counts = [(4,)] if is_fisheye else [(4,), (5,), (8,)]
    k = _array(where, entry, "distortions", *counts).tolist()
    lens = Lens("OPENCV_FISHEYE", tuple(k)) if is_fisheye else opencv_lens(k)
    return CalibratedImage(camera, lens)


def _array(where: str, entry: Mapping[str, Any], key: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """Return an entry as a finite array of one of `shapes`."""
    try:
        value = np.squeeze(np.array(entry.get(key), np.float64))
    except (TypeError, ValueError, OverflowError):
        value = np.zeros(0)
    expected = " or ".join(str([*shape]) for shape in shapes)
    require(
        value.shape in shapes and bounded(value),
        where,
        f"`{key}` must be finite numbers {expected} of at most {LARGEST:g}",
        shortened(entry[key]) if key in entry else "none",
        "calibrate this camera, or remove its table and its clip",
    )
    return value


def _calibration_files(path: Path) -> list[Path]:
    """Return the calibrations of a capture, in it or in its folder `calibration`."""
    files = []
    for file in calibration_files(path, "*.toml"):
        try:
            content = read_text(file, MAX_TOML)
        except (OSError, ValueError):
            # Not readable, a folder or a pipe, or more than a calibration.
            continue
        if _MARK.search(content):
            files.append(file)
    return files


READER = Reader(
    "Anipose",
    ("calibration.toml",),
    lambda path: bool(_calibration_files(path)),
    lambda path: only_calibration(
        path, _calibration_files(path), "one calibration in TOML", read_anipose
    ),
)

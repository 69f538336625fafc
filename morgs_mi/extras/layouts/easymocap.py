"""Calibrations of EasyMocap and EasyVolcap, the layout of ZJU-MoCap, ENeRF-Outdoor, SelfCap and
4K4D: OpenCV's matrices in `intri.yml` and `extri.yml`.

Of a camera NN, `intri.yml` has `K_NN` [3, 3] and the lens in `D_NN` or `dist_NN`, in OpenCV's
order. `extri.yml` has world -> camera with OpenCV's axes: the rotation as a matrix, `Rot_NN`, or as
a Rodrigues vector, `R_NN`, and the translation `T_NN`. EasyVolcap adds the size, `W_NN` and `H_NN`;
otherwise a camera was calibrated at the size of its clip. OpenCV puts pixel centres at integers, so
the principal point is shifted by half a pixel. World units are the file's, usually metres.

The masks of these recordings are silhouettes of each frame. They are not used, because a mask of a
capture is the same in all frames.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.capture.layouts.calibration import (
    CalibratedImage,
    Calibration,
    Reader,
    match_clips,
    required_clips,
)
from morgs_mi.capture.layouts.clips import clip_of_camera, size_of_clip
from morgs_mi.capture.lens import Lens, opencv_lens
from morgs_mi.core.camera import Camera, rigid
from morgs_mi.io.clip_readers import Clip
from morgs_mi.io.listing import existing_file
from morgs_mi.platform.bounded import read_text
from morgs_mi.platform.checks import bounded, errors_at, require

_LOG = logging.getLogger(__name__)

# A camera takes about 1 kB of either file.
_MAX_BYTES = 1_000_000
# OpenCV's parser ends the process at about 50,000 nested lists. A camera has about five lists.
_MAX_LISTS = 10_000
_FLAGS = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML


def read_easymocap(path: Path, clips: Mapping[str, Clip]) -> list[CalibratedImage]:
    """Return the cameras of `extri.yml`.

    Args:
        path: the file; `intri.yml` is beside it.
        clips: clips by name, which have the sizes of cameras without `W_NN` and `H_NN`.

    Raises:
        FileNotFoundError: there is no `intri.yml`.
        ValueError: a file is broken, or a matrix of a camera is missing or has another form.
    """
    source = path.with_name("intri.yml")
    existing_file(source, "the intrinsics", "copy it beside extri.yml")
    intrinsics = _read_storage(source)
    poses = _read_storage(path)
    keys = poses.root().keys()
    names = [key.removeprefix("T_") for key in keys if key.startswith("T_")]
    require(names, path, "expected `T_NN` for each camera NN", "none", "export it again")
    images = []
    for name in names:
        K = _matrix(source, intrinsics, f"K_{name}", 9).reshape(3, 3)
        K[:2, 2] += 0.5
        if _has(poses, f"Rot_{name}"):
            rotation = _matrix(path, poses, f"Rot_{name}", 9).reshape(3, 3)
        else:
            rotation, _ = cv2.Rodrigues(_matrix(path, poses, f"R_{name}", 3))
        translation = _matrix(path, poses, f"T_{name}", 3)
        viewmat = rigid(f"{path}, camera {name}", np.column_stack([rotation, translation]))
        # A camera without a clip is left out later, at whatever size.
        clip = clip_of_camera(clips, name) or next(iter(clips))
        with errors_at(f"{source}, camera {name}"):
            if _has(intrinsics, f"W_{name}"):
                width = round(intrinsics.getNode(f"W_{name}").real())
                height = round(intrinsics.getNode(f"H_{name}").real())
            else:
                width, height = size_of_clip(clips[clip])
            camera = Camera(K, viewmat, width, height, name)
        lens = Lens()
        for key in (f"dist_{name}", f"D_{name}"):
            if _has(intrinsics, key):
                lens = opencv_lens(_matrix(source, intrinsics, key, 4, 5, 8).tolist())
        images.append(CalibratedImage(camera, lens))
    return images


def _read_storage(path: Path) -> cv2.FileStorage:
    """Return the entries of a file of OpenCV.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is broken or too large.
    """
    text = read_text(path, _MAX_BYTES)
    lists = sum(text.count(mark) for mark in ("[", "{", "- "))
    require(lists <= _MAX_LISTS, path, f"expected at most {_MAX_LISTS} lists", lists, "correct it")
    storage = cv2.FileStorage()
    try:
        is_map = storage.open(text, _FLAGS) and storage.root().isMap()
    except cv2.error:
        is_map = False
    require(is_map, path, "expected OpenCV's YAML", "a broken file", "export it again")
    return storage


def _has(storage: cv2.FileStorage, key: str) -> bool:
    return not storage.getNode(key).empty()


def _matrix(path: Path, storage: cv2.FileStorage, key: str, *counts: int) -> np.ndarray:
    """Return the finite numbers of a matrix, row by row, of which there are one of `counts`."""
    try:
        matrix = storage.getNode(key).mat()
    except cv2.error:  # no matrix, or one of another size than it states
        matrix = None
    values = np.zeros(0) if matrix is None else matrix.ravel().astype(np.float64)
    require(
        values.size in counts and bounded(values),
        path,
        f"`{key}` must be a matrix of {' or '.join(map(str, counts))} finite numbers",
        "none that can be read" if matrix is None else matrix.tolist(),
        "calibrate this camera, or remove it from extri.yml",
    )
    return values


def _sources(path: Path) -> list[Path]:
    """Return the poses of a capture, which SelfCap has in a folder `optimized`."""
    return list(filter(Path.is_file, (path / "optimized" / "extri.yml", path / "extri.yml")))


def _read_calibration(path: Path) -> Calibration:
    source = _sources(path)[0]
    clips = required_clips(path)
    calibration = match_clips(path, source, clips, read_easymocap(source, clips))
    if any(view.masks for view in calibration.views):
        _LOG.warning("%s: not used, because masks of each frame are not read.", path / "masks")
    views = tuple(replace(view, masks=()) for view in calibration.views)
    return replace(calibration, views=views)


READER = Reader("EasyMocap", ("extri.yml",), lambda path: bool(_sources(path)), _read_calibration)

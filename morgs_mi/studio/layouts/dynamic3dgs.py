"""The layout of Dynamic 3D Gaussians: images in `ims/`, cameras in `train_meta.json`, points in
`init_pt_cld.npz`.

`train_meta.json` has `w` and `h`, and per frame and camera `fn` (the image below `ims/`), `cam_id`,
`k` [3, 3] in pixels with centres at +0.5, and `w2c` [4, 4], world -> camera with OpenCV's axes, so
no axis is flipped. `test_meta.json` lists the held-out cameras in the same way. The rows of
`init_pt_cld.npz` are x, y, z, r, g, b in [0, 1] and a label.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.layouts.calibration import NO_POINTS, Calibration, Reader
from morgs_mi.capture.lens import Lens
from morgs_mi.core.bounded import read_array, read_json
from morgs_mi.core.camera import Camera, rigid
from morgs_mi.core.checks import bounded
from morgs_mi.io.unread import warn_unread
from morgs_mi.io.video import natural_key

_LOG = logging.getLogger(__name__)

_KEYS = ("w", "h", "k", "w2c", "fn", "cam_id")


@dataclass(frozen=True)
class MetaCamera:
    """A camera of the file and its images, one per frame."""

    camera: Camera
    files: tuple[Path, ...]


def read_meta(path: Path) -> list[MetaCamera]:
    """Return the fixed cameras of `train_meta.json` or `test_meta.json`, named by their ids and in
    their order.

    Raises:
        ValueError: the file is broken, a key or an entry is missing, a pose is not rigid, or a
            camera moves.
    """
    meta = read_json(path)
    missing = [key for key in _KEYS if not isinstance(meta, dict) or key not in meta]
    if missing:
        raise ValueError(
            f"{path}: expected the keys {', '.join(_KEYS)}, {', '.join(missing)} missing; export "
            "again."
        )
    warn_unread(path, meta.keys() - set(_KEYS))
    rows = {key: meta[key] for key in ("fn", "cam_id", "k", "w2c")}
    if not all(
        isinstance(row, list) and row and all(isinstance(e, list) for e in row)
        for row in rows.values()
    ):
        raise ValueError(
            f"{path}: `fn`, `cam_id`, `k` and `w2c` must be lists of frames of cameras; export it "
            "again."
        )
    counts = {key: [len(entry) for entry in row] for key, row in rows.items()}
    count = counts["fn"][0]
    expected = [count] * len(counts["fn"])
    if not count or any(entries != expected for entries in counts.values()):
        table = ", ".join(
            f"{key} {len(c)} frames of {min(c)} to {max(c)} cameras" for key, c in counts.items()
        )
        raise ValueError(
            f"{path}: expected as many cameras in every frame and list, got {table}; export it "
            "again."
        )
    columns = [
        {str(camera_id): column for column, camera_id in enumerate(row)} for row in meta["cam_id"]
    ]
    for frame, row in enumerate(columns):
        if row.keys() != columns[0].keys() or len(row) < count:
            raise ValueError(
                f"{path}: frame {frame}: `cam_id` must name each camera of frame 0 once, got "
                f"{meta['cam_id'][frame]}; export it again."
            )
    names = sorted(columns[0], key=natural_key)
    return [_camera(path, meta, name, [row[name] for row in columns]) for name in names]


def _camera(path: Path, meta: dict[str, Any], name: str, columns: Sequence[int]) -> MetaCamera:
    """Return the camera in the columns `columns` of the frames."""
    where = f"{path}, camera {name}"
    try:
        K, w2c = (
            np.array([row[c] for row, c in zip(meta[key], columns, strict=True)], dtype=np.float64)
            for key in ("k", "w2c")
        )
    except (TypeError, ValueError, OverflowError):
        K = w2c = np.zeros(0)
    if K.shape[1:] != (3, 3) or w2c.shape[1:] not in ((4, 4), (3, 4)):
        raise ValueError(
            f"{where}: `k` must be [3, 3] and `w2c` [4, 4] in every frame; export it again."
        )
    for values, what in ((w2c, "pose"), (K, "intrinsics")):
        frames = np.flatnonzero(~np.isfinite(values).all((1, 2)))
        if len(frames):
            raise ValueError(
                f"{where}, frame {frames[0]}: the {what} must be finite, got NaN or Inf; "
                "calibrate again."
            )
        moving_frames = np.flatnonzero(
            np.abs(values - values[0]).max((1, 2)) > 1e-4 * (1 + np.abs(values[0]).max())
        )
        if len(moving_frames):
            raise ValueError(
                f"{where}: the {what} in frame {moving_frames[0]} must equal that in frame 0, as "
                "moving cameras are not supported; use a recording of fixed cameras."
            )
    sizes = meta["w"], meta["h"]
    if not all(isinstance(size, int) and size > 0 for size in sizes):
        raise ValueError(
            f"{path}: `w` and `h` must be positive whole numbers, got {sizes}; export it again."
        )
    viewmat = rigid(where, w2c[0])
    try:
        camera = Camera(K[0], viewmat, *sizes, name=name)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    files = [row[c] for row, c in zip(meta["fn"], columns, strict=True)]
    return MetaCamera(camera, tuple(path.parent / "ims" / str(file) for file in files))


def read_point_cloud(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions [P, 3] and colours [P, 3] in [0, 1] in `init_pt_cld.npz`.

    Raises:
        ValueError: it is not a NumPy archive with an array `data` [P, 6 or more] of finite numbers.
    """
    rows = read_array(path, "data")
    if rows.ndim != 2 or rows.shape[1] < 6 or rows.dtype.kind not in "fiu" or not bounded(rows):
        raise ValueError(
            f"{path}: `data` must be [P, 7], finite, got {rows.dtype} {rows.shape}; export it "
            "again."
        )
    return rows[:, :3], rows[:, 3:6].astype(np.float32)


def _read_calibration(path: Path) -> Calibration:
    """Return the training cameras and the test cameras, which are held out; cameras without images
    are left out.
    """
    training = read_meta(path / "train_meta.json")
    test = read_meta(path / "test_meta.json") if (path / "test_meta.json").is_file() else []
    held_out = {view.camera.name for view in test}
    rig = [*(view for view in training if view.camera.name not in held_out), *test]
    rig.sort(key=lambda view: natural_key(view.camera.name))
    empty = [view.camera.name for view in rig if not any(file.exists() for file in view.files)]
    if empty and len(empty) < len(rig):
        _LOG.warning("%s: no image of %s was found: left out.", path / "ims", ", ".join(empty))
        rig = [view for view in rig if view.camera.name not in empty]
    cloud = path / "init_pt_cld.npz"
    points, colors = read_point_cloud(cloud) if cloud.is_file() else (NO_POINTS, NO_POINTS)
    cameras = tuple(view.camera for view in rig)
    clips = tuple(view.files for view in rig)
    test_views = tuple(index for index, camera in enumerate(cameras) if camera.name in held_out)
    return Calibration(cameras, (Lens(),) * len(rig), clips, points, colors, test_views or None)


READER = Reader(
    "Dynamic 3D Gaussians",
    ("train_meta.json",),
    lambda path: (path / "train_meta.json").is_file(),
    _read_calibration,
)

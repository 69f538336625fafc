"""The layout of Dynamic 3D Gaussians: images in `ims/`, cameras in `train_meta.json`, points in
`init_pt_cld.npz`.

`train_meta.json` has `w` and `h`, and per frame and camera `fn` (the image below `ims/`), `cam_id`,
`k` [3, 3] in pixels with centres at +0.5, and `w2c` [4, 4], world -> camera with OpenCV's axes, so
no axis is flipped. `test_meta.json` lists the held-out cameras in the same way. The rows of
`init_pt_cld.npz` are x, y, z, r, g, b in [0, 1] and a label.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from morgs_mi.capture.layouts.calibration import NO_POINTS, CalibratedView, Calibration, Reader
from morgs_mi.core.camera import Camera, rigid
from morgs_mi.io.numbering import natural_key
from morgs_mi.platform.bounded import read_array, read_json, warn_unread
from morgs_mi.platform.checks import bounded, errors_at, numbers, require

_LOG = logging.getLogger(__name__)

_KEYS = ("w", "h", "k", "w2c", "fn", "cam_id")


def read_meta(path: Path) -> dict[str, tuple[Camera, tuple[Path, ...]]]:
    """Return the fixed cameras of `train_meta.json` or `test_meta.json` by their ids, each with its
    images, one per frame.

    Raises:
        ValueError: the file is broken, a key or an entry is missing, a pose is not rigid, or a
            camera moves.
    """
    meta = read_json(path)
    missing = [key for key in _KEYS if not isinstance(meta, dict) or key not in meta]
    requirement = f"expected the keys {', '.join(_KEYS)}"
    require(not missing, path, requirement, f"none of {', '.join(missing)}", "export again")
    warn_unread(path, meta.keys() - set(_KEYS))
    frames = []
    try:
        for entries in zip(*(meta[key] for key in ("cam_id", "k", "w2c", "fn")), strict=True):
            rows = list(zip(*entries, strict=True))
            frames.append({str(camera_id): row for camera_id, *row in rows})
            if not rows or len(frames[-1]) < len(rows) or frames[-1].keys() != frames[0].keys():
                raise ValueError("`cam_id` must name each camera of frame 0 once")
        by_camera = {name: [frame[name] for frame in frames] for name in frames[0]}
    except (TypeError, ValueError, LookupError) as error:
        raise ValueError(
            f"{path}: expected lists of frames in `fn`, `cam_id`, `k` and `w2c`, with as many "
            f"cameras in every frame, got others after {len(frames)} frames ({error}); export it "
            "again."
        ) from None
    cameras = {}
    for name, rows in by_camera.items():
        where = f"{path}, camera {name}"
        Ks, poses, files = zip(*rows, strict=True)
        K = numbers(where, "k", Ks, len(frames), 3, 3)
        w2c = numbers(where, "w2c", poses)
        viewmat = rigid(where, w2c[0])
        for values, what in ((w2c, "pose"), (K, "intrinsics")):
            changes = np.abs(values - values[0]).max((1, 2))
            moving = ~(changes <= 1e-4 * (1 + np.abs(values[0]).max()))  # also where it is NaN
            requirement = f"the {what} in frame {moving.argmax()} must equal that in frame 0"
            require(
                not moving.any(),
                where,
                requirement,
                values[moving.argmax()].tolist(),
                "use a recording of fixed cameras, as moving cameras are not supported",
            )
        with errors_at(where):
            camera = Camera(K[0], viewmat, meta["w"], meta["h"], name=name)
        cameras[name] = camera, tuple(path.parent / "ims" / str(file) for file in files)
    return cameras


def read_point_cloud(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions [P, 3] and colours [P, 3] in [0, 1] in `init_pt_cld.npz`.

    Raises:
        ValueError: it is not a NumPy archive with an array `data` [P, 6 or more] of finite numbers.
    """
    rows = numbers(path, "data", read_array(path, "data"))
    require(
        rows.ndim == 2 and rows.shape[1] >= 6 and bounded(rows),
        path,
        "`data` must be [P, 7], finite",
        f"{rows.dtype} {rows.shape}",
        "export it again",
    )
    return rows[:, :3], rows[:, 3:6].astype(np.float32)


def _read_calibration(path: Path) -> Calibration:
    """Return the training cameras and the test cameras, which are held out; cameras without images
    are left out.
    """
    test = read_meta(path / "test_meta.json") if (path / "test_meta.json").is_file() else {}
    rig = read_meta(path / "train_meta.json") | test
    names = sorted(rig, key=natural_key)
    empty = [name for name in names if not any(file.exists() for file in rig[name][1])]
    if empty and len(empty) < len(rig):
        _LOG.warning("%s: no image of %s was found: left out.", path / "ims", ", ".join(empty))
        names = [name for name in names if name not in empty]
    cloud = path / "init_pt_cld.npz"
    points, colors = read_point_cloud(cloud) if cloud.is_file() else (NO_POINTS, NO_POINTS)
    pairs = (rig[name] for name in names)
    views = tuple(CalibratedView(camera, clip=clip) for camera, clip in pairs)
    held_out = tuple(name for name in names if name in test)
    return Calibration(views, points, colors, held_out or None, unused=tuple(empty))


READER = Reader(
    "Dynamic 3D Gaussians",
    ("train_meta.json",),
    lambda path: (path / "train_meta.json").is_file(),
    _read_calibration,
)

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
    keys = meta.keys() if isinstance(meta, dict) else set()
    missing = ", ".join(sorted({*_KEYS} - keys))
    requirement = f"expected the keys {', '.join(_KEYS)}"
    require(not missing, path, requirement, f"none of {missing}", "export again")
    warn_unread(path, keys - {*_KEYS})
    ids = np.array(meta["cam_id"], object)
    files = np.array(meta["fn"], object)
    K = numbers(path, "k", meta["k"])
    w2c = numbers(path, "w2c", meta["w2c"])
    shape = K.shape[:2]  # frames, cameras
    require(
        (ids.shape, files.shape, w2c.shape[:2], K.shape) == (shape, shape, shape, (*shape, 3, 3)),
        path,
        "`cam_id`, `fn`, `w2c` and `k` must have as many cameras in every frame",
        f"the shapes {ids.shape}, {files.shape}, {w2c.shape[:2]}, {K.shape}",
        "export it again",
    )
    # The order of the cameras may change from frame to frame.
    order = ids.astype(str).argsort(axis=1)
    ids = np.take_along_axis(ids.astype(str), order, axis=1)
    names = ids[0].tolist()
    require(
        (ids == ids[0]).all() and len({*names}) == len(names),
        path,
        "`cam_id` must name each camera of frame 0 once in every frame",
        f"another camera in frame {(ids != ids[0]).any(axis=1).argmax()}",
        "export it again",
    )
    files = np.take_along_axis(files, order, axis=1)
    K = np.take_along_axis(K, order[..., None, None], axis=1)
    w2c = np.take_along_axis(w2c, order[..., None, None], axis=1)
    cameras = {}
    for index, name in enumerate(names):
        where = f"{path}, camera {name}"
        viewmat = rigid(where, w2c[0, index])
        for values, what in ((w2c[:, index], "pose"), (K[:, index], "intrinsics")):
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
            camera = Camera(K[0, index], viewmat, meta["w"], meta["h"], name=name)
        clip = tuple(path.parent / "ims" / str(file) for file in files[:, index])
        cameras[name] = camera, clip
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
    present = [name for name in names if any(map(Path.exists, rig[name][1]))]
    empty = sorted({*names} - {*present}, key=natural_key)
    if empty and present:
        _LOG.warning("%s: no image of %s was found: left out.", path / "ims", ", ".join(empty))
        names = present
    cloud = path / "init_pt_cld.npz"
    points, colors = read_point_cloud(cloud) if cloud.is_file() else (NO_POINTS, NO_POINTS)
    views = tuple(CalibratedView(rig[name][0], clip=rig[name][1]) for name in names)
    held_out = tuple(name for name in names if name in test)
    return Calibration(views, points, colors, held_out or None, unused=tuple(empty))


READER = Reader(
    "Dynamic 3D Gaussians",
    ("train_meta.json",),
    lambda path: (path / "train_meta.json").is_file(),
    _read_calibration,
)

"""Which layout a capture folder has, found by what lies in it, and the calibration that it holds.

Where a folder holds several calibrations the one that says most wins: a COLMAP model (lenses, principal points,
points), then ``transforms.json``, then ``train_meta.json``, then ``poses_bounds.npy``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from morgs_mi.capture.layouts.clips import check_frames, clips_by_camera, clips_by_frame, view_of_image
from morgs_mi.capture.layouts.colmap import find_colmap, read_colmap
from morgs_mi.capture.layouts.dynamic3dgs import read_meta, read_point_cloud
from morgs_mi.capture.layouts.nerfstudio import read_points_ply, read_transforms
from morgs_mi.capture.layouts.poses_bounds import count_rows, read_poses_bounds
from morgs_mi.capture.lens import Lens
from morgs_mi.core.camera import Camera
from morgs_mi.io.video import VIDEO_SUFFIXES, Clip, natural_key

__all__ = ["Calibration", "read_calibration"]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Calibration:
    """What a capture folder says about its cameras, at the size they were calibrated at.

    Attributes:
        layout: what it is called, e.g. ``COLMAP``.
        cameras: in numerical order of their names.
        lenses: one per camera.
        clips: where each camera's frames lie.
        points: [P, 3] float32, world units; P = 0 where the layout has none.
        point_colors: [P, 3] float32 in [0, 1].
        test_view: index of the camera that the layout holds out; None where it does not say.
    """

    layout: str
    cameras: tuple[Camera, ...]
    lenses: tuple[Lens, ...]
    clips: tuple[Clip, ...]
    points: np.ndarray
    point_colors: np.ndarray
    test_view: int | None = None


_NO_POINTS = np.zeros((0, 3), np.float32)


def read_calibration(path: Path) -> Calibration:
    """Find and read the calibration of the capture folder `path`.

    Raises:
        FileNotFoundError: the calibration, or a clip that it names, is missing.
        ValueError: a file is broken, or does not fit the clips.
    """
    colmap = find_colmap(path)
    transforms = path / "transforms.json"
    if colmap is None and not transforms.is_file() and (path / "train_meta.json").is_file():
        return _dynamic3dgs(path)
    if not clips_by_camera(path):
        raise FileNotFoundError(
            f"{path}: expected videos ({', '.join(VIDEO_SUFFIXES)}) or folders of frames, found none; check the path."
        )
    if colmap is not None:
        model = read_colmap(colmap)
        named = _by_name(path, colmap, model.cameras, model.lenses)
        return Calibration("COLMAP", *named, model.points, model.point_colors)
    if transforms.is_file():
        cameras, lenses, ply = read_transforms(transforms)
        points, colors = read_points_ply(ply) if ply else (_NO_POINTS, _NO_POINTS)
        named = _by_name(path, transforms, cameras, lenses)
        return Calibration("Nerfstudio", *named, points, colors)
    if (path / "poses_bounds.npy").is_file():
        return _poses_bounds(path)
    raise FileNotFoundError(
        f"{path}: expected a calibration (sparse/0, sparse, transforms.json, train_meta.json or poses_bounds.npy), "
        "found none; run `morgs-mi calibrate` on the folder."
    )


def _by_name(
    path: Path, source: Path, cameras: Sequence[Camera], lenses: Sequence[Lens]
) -> tuple[tuple[Camera, ...], tuple[Lens, ...], tuple[Clip, ...]]:
    """Give each fixed camera of a calibration whose images are named its clip, in numerical order of the names."""
    views: dict[str, Clip] = dict(clips_by_camera(path))
    try:
        group = _grouped(source, views, cameras, lenses)
    except (FileNotFoundError, ValueError) as error:
        views = dict(by_frame := clips_by_frame(path))
        try:
            group = _grouped(source, views, cameras, lenses)
        except (FileNotFoundError, ValueError):
            raise error from None
        check_frames(path, by_frame)
    if unused := [name for name in views if name not in group]:
        _LOG.warning("%s does not calibrate %s: not used.", source, ", ".join(unused))
    names = sorted(group, key=natural_key)
    picked = [group[name] for name in names]
    return (
        tuple(replace(cameras[i], name=name) for i, name in zip(picked, names, strict=True)),
        tuple(lenses[i] for i in picked),
        tuple(views[name] for name in names),
    )


def _grouped(source: Path, views: dict[str, Clip], cameras: Sequence[Camera], lenses: Sequence[Lens]) -> dict[str, int]:
    """Return the index of one of the `cameras` per clip of `views`, by the clip's name."""
    found: dict[str, int] = {}
    for index, camera in enumerate(cameras):
        name = view_of_image(views, camera.name)
        if name is None:
            raise FileNotFoundError(
                f"{source}: its image {camera.name!r} needs a clip called {Path(camera.name).stem}, found "
                f"{', '.join(views) or 'none'}; name the clips after the calibration's images."
            )
        first = found.setdefault(name, index)
        same = np.allclose(cameras[first].viewmat, camera.viewmat, atol=1e-6) and lenses[first] == lenses[index]
        if not (same and np.allclose(cameras[first].K, camera.K)):
            raise ValueError(
                f"{source}: cameras must not move, but {cameras[first].name!r} and {camera.name!r}, both of {name}, "
                "have different poses or lenses; keep one image of each fixed camera, and name the clips after them."
            )
    return found


def _poses_bounds(path: Path) -> Calibration:
    """Match the rows to the clips: a folder per camera, or if their number fits better, a folder per frame."""
    source = path / "poses_bounds.npy"
    views: dict[str, Clip] = dict(clips_by_camera(path))
    if len(views) != count_rows(source) == len(by_frame := clips_by_frame(path)):
        check_frames(path, by_frame)
        views = dict(by_frame)
    cameras, _ = read_poses_bounds(source, list(views))
    lenses = (Lens(),) * len(cameras)
    return Calibration("poses_bounds", cameras, lenses, tuple(views.values()), _NO_POINTS, _NO_POINTS)


def _dynamic3dgs(path: Path) -> Calibration:
    """Take the training cameras and, to be held out, the first test camera."""
    rig = read_meta(path / "train_meta.json")
    test_view = None
    if (path / "test_meta.json").is_file():
        held_out, *others = read_meta(path / "test_meta.json")
        if others:
            names = ", ".join(view.camera.name for view in others)
            _LOG.info("%s: %s is held out, %s not used.", path / "test_meta.json", held_out.camera.name, names)
        others = [view for view in rig if view.camera.name != held_out.camera.name]
        rig = sorted([*others, held_out], key=lambda view: natural_key(view.camera.name))
        test_view = [view.camera.name for view in rig].index(held_out.camera.name)
    cloud = path / "init_pt_cld.npz"
    points, colors = read_point_cloud(cloud) if cloud.is_file() else (_NO_POINTS, _NO_POINTS)
    cameras = tuple(view.camera for view in rig)
    lenses = (Lens(),) * len(rig)
    return Calibration(
        "Dynamic 3D Gaussians", cameras, lenses, tuple(view.files for view in rig), points, colors, test_view
    )

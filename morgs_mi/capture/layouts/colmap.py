"""COLMAP's sparse models: reader for text and binary files, writer for text.

A model is a folder of cameras, images and points3D (newer versions add rigs and frames, which
repeat the poses). COLMAP's pixel centres lie at +0.5 and its axes are OpenCV's, as in `Camera`, so
no axis is flipped.

The reader does not use pycolmap because pycolmap 4.2 never returns from a truncated binary file
and silently drops every second image of a text model without blank lines.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.capture.layouts.calibration import Calibration, Layout, match_clips, required_clips
from morgs_mi.capture.layouts.colmap_files import (
    binary_cameras,
    binary_images,
    binary_points,
    count_images,
    text_cameras,
    text_images,
    text_points,
)
from morgs_mi.capture.lens import Lens, lens_and_intrinsics
from morgs_mi.core.bounded import check_claim
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import LARGEST, bounded
from morgs_mi.core.colmap_library import import_pycolmap
from morgs_mi.core.files import write_error
from morgs_mi.io.listing import listed
from morgs_mi.io.video import natural_key

if TYPE_CHECKING:
    import pycolmap

_LOG = logging.getLogger(__name__)

_FILES = ("cameras", "images", "points3D")
# Memory of a `Camera`, which a line of a few characters may describe.
_CAMERA_BYTES = 500


@dataclass(frozen=True)
class ColmapModel:
    """A COLMAP model, before undistortion."""

    #: One camera per image in the order of the file; `name` is the name of the image.
    cameras: tuple[Camera, ...]
    lenses: tuple[Lens, ...]  #: One lens per camera.
    points: np.ndarray  #: [P, 3] float32, world units.
    point_colors: np.ndarray  #: [P, 3] float32 in [0, 1], display-referred.


def find_colmap(folder: Path) -> Path | None:
    """Return the folder of the COLMAP model in a capture, or None.

    It is in a numbered folder of `sparse`, in `sparse`, in another folder of it, likewise in
    `colmap/sparse`, or in the capture itself. COLMAP writes several models, in any order, if it
    cannot connect all images: the one of most images is used.
    """
    return next(iter(_models(folder)), None)


def _models(folder: Path) -> list[Path]:
    """Return the folders of the models of a capture, of which the first is used."""
    for place in (folder / "sparse", folder / "colmap" / "sparse"):
        inner = [model for model in listed(place) if _holds_model(model)] if place.is_dir() else []
        if models := [model for model in inner if model.name.isdecimal()]:
            return _largest_first(models)
        if _holds_model(place):
            return [place]
        if inner:
            return _largest_first(inner)
    return [folder] if _is_model(folder) else []


def _is_model(folder: Path) -> bool:
    """Return whether a capture folder has all three files: a single name may have another meaning
    there.
    """
    return any(
        all((folder / f"{name}.{kind}").exists() for name in _FILES) for kind in ("bin", "txt")
    )


def _largest_first(models: Sequence[Path]) -> list[Path]:
    models = sorted(models, key=lambda model: natural_key(model.name))
    return sorted(models, key=count_images, reverse=True) if len(models) > 1 else models


def _holds_model(folder: Path) -> bool:
    return any((folder / f"cameras.{kind}").exists() for kind in ("bin", "txt"))


def read_colmap(folder: str | Path) -> ColmapModel:
    """Read the COLMAP model in `folder`, binary if present, otherwise text.

    Raises:
        FileNotFoundError: one of the three files is missing.
        ValueError: a file is broken, refers to a missing camera, or holds an invalid pose or an
            unsupported lens.
    """
    folder = Path(folder)
    kind = "bin" if (folder / "cameras.bin").exists() else "txt"
    _check_complete(folder, kind)
    cameras_path, images_path, points_path = (folder / f"{name}.{kind}" for name in _FILES)
    views = _views(images_path, cameras_path, _intrinsics(cameras_path))
    if not views:
        raise ValueError(
            f"{images_path}: expected at least one image, got none; register the images."
        )
    cameras, lenses = zip(*views, strict=True)
    points = _points(points_path)
    return ColmapModel(
        cameras,
        lenses,
        points[:, :3].astype(np.float32),
        (points[:, 3:] / 255).astype(np.float32),
    )


def _check_complete(folder: Path, kind: str) -> None:
    for name in _FILES:
        if not (folder / f"{name}.{kind}").exists():
            raise FileNotFoundError(
                f"{folder}: a COLMAP model needs cameras, images and points3D (.txt or .bin), "
                f"{name}.{kind} is missing; export the whole model."
            )


class _Intrinsics(NamedTuple):
    lens: Lens
    K: np.ndarray
    width: int
    height: int


def _intrinsics(path: Path) -> dict[int, _Intrinsics]:
    """Return the cameras of a model by their ids."""
    intrinsics: dict[int, _Intrinsics] = {}
    rows = (binary_cameras if path.suffix == ".bin" else text_cameras)(path)
    for camera_id, model, width, height, params in rows:
        try:
            lens, K = lens_and_intrinsics(model, params)
        except ValueError as error:
            raise ValueError(f"{path}: camera {camera_id}: {error}") from None
        intrinsics[camera_id] = _Intrinsics(lens, K, width, height)
        check_claim(path, _CAMERA_BYTES * len(intrinsics), f"{len(intrinsics)} cameras")
    return intrinsics


def _views(
    path: Path, cameras_path: Path, intrinsics: Mapping[int, _Intrinsics]
) -> list[tuple[Camera, Lens]]:
    """Return the camera and the lens of each image of a model."""
    views: list[tuple[Camera, Lens]] = []
    for name, camera_id, pose in (binary_images if path.suffix == ".bin" else text_images)(path):
        if camera_id not in intrinsics:
            raise ValueError(
                f"{path}: image {name!r} refers to camera {camera_id}, {cameras_path.name} "
                f"has {sorted(intrinsics)}; export both files from the same model."
            )
        lens, K, width, height = intrinsics[camera_id]
        try:
            views.append((Camera(K, _viewmat(pose), width, height, name), lens))
        except ValueError as error:
            raise ValueError(f"{path}, image {name!r}: {error}") from None
        check_claim(path, _CAMERA_BYTES * len(views), f"{len(views)} images")
    return views


def _points(path: Path) -> np.ndarray:
    """Return the positions and the colours, 0 to 255, of the points of a model [P, 6]."""
    rows = (binary_points if path.suffix == ".bin" else text_points)(path)
    points = np.asarray(np.fromiter(rows, np.dtype((np.float64, 6))), np.float64)
    if not bounded(points):
        raise ValueError(
            f"{path}: the points must be finite and at most {LARGEST:g}, got others; "
            "export the model again."
        )
    return points


def write_colmap(
    folder: str | Path,
    cameras: Sequence[Camera],
    points: np.ndarray | None = None,
    point_colors: np.ndarray | None = None,
    lenses: Sequence[Lens] | None = None,
) -> None:
    """Write a COLMAP text model that COLMAP itself can read.

    Args:
        folder: created if missing.
        cameras: the views; the image of a view is called `name`, with ``.png`` added if it has no
            suffix.
        points: [P, 3] world units, or None for no points.
        point_colors: [P, 3] in [0, 1]; grey if None.
        lenses: one per camera, as in `ColmapModel`; pinholes if None.

    Raises:
        OSError: a file could not be written.
    """
    pycolmap = import_pycolmap()  # takes 0.3 s to import, and only the writer needs it

    model = pycolmap.Reconstruction()
    lenses = [Lens()] * len(cameras) if lenses is None else lenses
    for i, (camera, lens) in enumerate(zip(cameras, lenses, strict=True), start=1):
        _add_view(model, i, camera, lens)
    points = np.zeros((0, 3)) if points is None else np.asarray(points)
    for xyz, rgb in zip(points, _color_bytes(points, point_colors), strict=True):
        model.add_point3D(xyz.astype(np.float64), pycolmap.Track(), rgb)
    write_reconstruction(model, folder)


def _add_view(model: pycolmap.Reconstruction, index: int, camera: Camera, lens: Lens) -> None:
    pycolmap = import_pycolmap()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=index,
            model=lens.model,
            width=camera.width,
            height=camera.height,
            params=_parameters(camera, lens),
        )
    )
    image = pycolmap.Image(image_id=index, camera_id=index, name=_image_name(camera))
    pose = pycolmap.Rigid3d(np.asarray(camera.viewmat, dtype=np.float64)[:3])
    model.add_image_with_trivial_frame(image, pose)


def _color_bytes(points: np.ndarray, colors: np.ndarray | None) -> np.ndarray:
    """Return the colours of points [P, 3] as bytes, grey if None."""
    colors = np.full(points.shape, 0.5) if colors is None else np.asarray(colors)
    return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)


def _image_name(camera: Camera) -> str:
    return camera.name if Path(camera.name).suffix else f"{camera.name}.png"


def _parameters(camera: Camera, lens: Lens) -> list[float]:
    """Return the parameters of COLMAP's camera model."""
    one_focal = lens.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    focals = np.diag(camera.K)[: 1 if one_focal else 2]
    return [*focals, *camera.K[:2, 2], *lens.distortion]


def write_reconstruction(model: pycolmap.Reconstruction, folder: str | Path) -> None:
    """Write all files of a model as text, or none; the folder is created if it is missing.

    Raises:
        OSError: a file could not be written.
    """
    folder = Path(folder)
    lines = _line_counts(model)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".partial-", dir=folder) as partial:
            model.write_text(partial)
            files = [Path(partial) / f"{name}.txt" for name in lines]
            for file, count in zip(files, lines.values(), strict=True):
                _check_written(file, count)
            for file in files:
                file.replace(folder / file.name)
    except (OSError, RuntimeError, ValueError) as error:
        raise write_error(
            f"{folder}: the COLMAP model could not be written", error, folder
        ) from error


def _line_counts(model: pycolmap.Reconstruction) -> dict[str, int]:
    """Return the number of lines of each text file of a model."""
    return {
        "rigs": model.num_rigs(),
        "frames": model.num_reg_frames(),
        "images": 2 * model.num_reg_images(),
        "points3D": model.num_points3D(),
        # The last one that is renamed, because readers look for it.
        "cameras": model.num_cameras(),
    }


def _check_written(file: Path, expected: int) -> None:
    """Check that a text file reached the disk with all its lines: pycolmap does not report a full
    disk.

    Raises:
        OSError: it did not.
    """
    lines = _lines_on_disk(file)
    if len(lines) != expected or (lines and not lines[-1].endswith(b"\n")):
        raise OSError(f"{file.name} was cut off after {len(lines)} of {expected} lines")


def _lines_on_disk(file: Path) -> list[bytes]:
    """Return the lines of a file that are not comments, after it is written to the disk."""
    with file.open("rb") as stream:
        os.fsync(stream.fileno())
        return [line for line in stream if not line.startswith(b"#")]


def _viewmat(pose: Sequence[float]) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of a wxyz quaternion and a translation."""
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose must be finite, got {[*pose]}; export the model again.")
    quat = np.array(pose[:4])
    _check_unit(quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
    viewmat[:3, 3] = pose[4:]
    return viewmat


def _check_unit(quat: np.ndarray) -> None:
    """Check that a quaternion has length 1, as COLMAP writes them."""
    if not abs(np.linalg.norm(quat) - 1) <= 1e-2:
        raise ValueError(
            f"its quaternion must have length 1, got {quat.tolist()}; check the order of the "
            "columns."
        )


def _warn_several(folder: Path, others: Sequence[Path]) -> None:
    """Warn that a capture has other models than the one that is used."""
    counts = ", ".join(f"{model.name} has {count_images(model)}" for model in others)
    _LOG.warning(
        "%s: the largest of %d models, %s with %d images, is used; %s.",
        *(folder.parent, 1 + len(others), folder.name, count_images(folder), counts),
    )


def _read_calibration(path: Path) -> Calibration:
    clips = required_clips(path)
    folder, *others = _models(path)
    if others:
        _warn_several(folder, others)
    model = read_colmap(folder)
    match = match_clips(path, folder, clips, model.cameras, model.lenses)
    return replace(match.calibration, points=model.points, point_colors=model.point_colors)


LAYOUT = Layout(
    "COLMAP", ("sparse/0", "sparse"), lambda path: find_colmap(path) is not None, _read_calibration
)

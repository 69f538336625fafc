"""COLMAP's sparse models: reader for text and binary files, writer for text.

A model is a folder of cameras, images and points3D (newer versions add rigs and frames, which
repeat the poses). COLMAP's pixel centres lie at +0.5 and its axes are OpenCV's, as in `Camera`, so
no axis is flipped.

The reader does not use pycolmap because pycolmap 4.2 never returns from a truncated binary file
and silently drops every second image of a text model without blank lines.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.capture.layouts.calibration import (
    NO_POINTS,
    CalibratedImage,
    Calibration,
    Reader,
    match_clips,
    required_clips,
)
from morgs_mi.capture.layouts.colmap_files import (
    model_file,
    read_cameras,
    read_images,
    read_points,
)
from morgs_mi.capture.layouts.nerfstudio import read_points_ply
from morgs_mi.capture.lens import MODELS, lens_and_intrinsics
from morgs_mi.core.camera import Camera
from morgs_mi.io.listing import existing_file
from morgs_mi.io.numbering import natural_key
from morgs_mi.platform.bounded import check_claim
from morgs_mi.platform.checks import errors_at, few
from morgs_mi.platform.files import atomic_path

_LOG = logging.getLogger(__name__)

_FILES = ("cameras", "images")
# Memory of a `Camera`, which a line of a few characters may describe.
_CAMERA_BYTES = 500


@dataclass(frozen=True)
class ColmapModel:
    """A COLMAP model, before undistortion."""

    images: tuple[CalibratedImage, ...]  #: In the order of the file.
    points: np.ndarray  #: [P, 3], world units; P = 0 if there are none.
    point_colors: np.ndarray  #: [P, 3] float32 in [0, 1], display-referred.


def find_models(folder: Path) -> list[Path]:
    """Return the folders of the COLMAP models in a capture, of which the first is used.

    They are numbered folders of `sparse` or `sparse` itself, likewise of `colmap/sparse`, or the
    capture itself. COLMAP writes several models if it cannot connect all images.
    """
    for place in (folder / "sparse", folder / "colmap" / "sparse"):
        numbered = sorted(place.glob("[0-9]*"), key=lambda model: natural_key(model.name))
        decimal = [model for model in numbered if model.name.isdecimal()]
        if models := [*filter(_holds_model, (*decimal, place))]:
            return models
    # In a capture itself, a single name may have another meaning.
    return [folder] if all(model_file(folder, name).exists() for name in _FILES) else []


def _holds_model(folder: Path) -> bool:
    return model_file(folder, "cameras").exists()


def read_colmap(folder: str | Path) -> ColmapModel:
    """Read the COLMAP model in `folder`, binary if present, otherwise text; its points may be in
    `points3D.ply`, or missing.

    Raises:
        FileNotFoundError: the cameras or the images are missing.
        ValueError: a file is broken, refers to a missing camera, or holds an invalid pose or an
            unsupported lens. Points are not checked.
    """
    folder = Path(folder)
    cameras_path, images_path = (
        existing_file(
            model_file(folder, name), "a file of a COLMAP model", "export the whole model"
        )
        for name in _FILES
    )
    intrinsics = {}
    for camera_id, model, *size, params in read_cameras(cameras_path):
        with errors_at(f"{cameras_path}: camera {camera_id}"):
            intrinsics[camera_id] = (*lens_and_intrinsics(model, params), *size)
        check_claim(cameras_path, _CAMERA_BYTES * len(intrinsics), f"{len(intrinsics)} cameras")
    images: list[CalibratedImage] = []
    for name, camera_id, pose in read_images(images_path):
        with errors_at(f"{images_path}, image {name!r}"):
            if camera_id not in intrinsics:
                raise ValueError(f"it refers to camera {camera_id}, of {few(sorted(intrinsics))}")
            lens, K, width, height = intrinsics[camera_id]
            quat = np.array(pose[:4])
            # COLMAP writes quaternions of length 1.
            if not abs(np.linalg.norm(quat) - 1) <= 1e-2:
                raise ValueError(f"its quaternion must have length 1, got {[*pose]}; correct it.")
            viewmat = np.eye(4)
            viewmat[:3, :3] = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
            viewmat[:3, 3] = pose[4:]
            images.append(CalibratedImage(Camera(K, viewmat, width, height, name), lens))
        check_claim(images_path, _CAMERA_BYTES * len(images), f"{len(images)} images")
    if not images:
        raise ValueError(f"{images_path}: expected at least one image, got none; register them.")
    others = (folder / f"points3D.{suffix}" for suffix in ("bin", "txt", "ply"))
    path = next(filter(Path.exists, (model_file(folder, "points3D"), *others)), None)
    if path is None:
        points = colors = NO_POINTS
    elif path.suffix == ".ply":
        points, colors = read_points_ply(path)
    else:
        rows = np.fromiter(read_points(path), np.dtype((np.float64, 6)))
        table = np.asarray(rows, np.float64)
        points, colors = np.hsplit(table, 2)
        colors = (colors / 255).astype(np.float32)
    return ColmapModel(tuple(images), points, colors)


def write_colmap(
    folder: str | Path,
    images: Sequence[Camera | CalibratedImage],
    points: np.ndarray = NO_POINTS,
    point_colors: np.ndarray | None = None,
) -> None:
    """Write a COLMAP text model that COLMAP itself can read.

    Args:
        folder: created if missing.
        images: cameras, with their lenses if these are not pinholes; an image is called `name`,
            with ``.png`` added if that has no suffix.
        points: [P, 3] world units; none by default.
        point_colors: [P, 3] in [0, 1]; grey if None.

    Raises:
        OSError: a file could not be written.
    """
    folder = Path(folder)
    points = np.asarray(points, np.float64)
    colors = np.full(points.shape, 0.5) if point_colors is None else np.asarray(point_colors)
    colors = np.rint(np.clip(colors, 0, 1) * 255).astype(int)
    image_lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of points\n"]
    camera_lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n"]
    for i, image in enumerate(images, start=1):
        image = image if isinstance(image, CalibratedImage) else CalibratedImage(image)
        camera = image.camera
        lens = image.lens
        viewmat = camera.world_to_camera
        x, y, z, w = Rotation.from_matrix(viewmat[:3, :3]).as_quat(canonical=True).tolist()
        name = camera.name if Path(camera.name).suffix else f"{camera.name}.png"
        image_lines.append(_line(i, w, x, y, z, *viewmat[:3, 3].tolist(), i, name))
        image_lines.append("\n")  # no points
        focals = np.diag(camera.K)[: MODELS[lens.model][0]].tolist()
        params = (*focals, *camera.K[:2, 2].tolist(), *lens.distortion)
        camera_lines.append(_line(i, lens.model, camera.width, camera.height, *params))
    point_lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]\n"]
    for i, (xyz, rgb) in enumerate(zip(points, colors, strict=True), start=1):
        # The error of a point is not known, and its track is empty.
        point_lines.append(_line(i, *xyz.tolist(), *rgb.tolist(), 0.0))
    # The first file is the last one that is renamed, because readers look for it.
    texts = {"cameras": camera_lines, "images": image_lines, "points3D": point_lines}
    with ExitStack() as files:
        for name, lines in texts.items():
            file = atomic_path(folder / f"{name}.txt", "write_colmap()", parents=True)
            files.enter_context(file).write_text("".join(lines), encoding="utf-8")


def _line(*fields: object) -> str:
    return " ".join(map(str, fields)) + "\n"


def _read_calibration(path: Path) -> Calibration:
    clips = required_clips(path)
    folder, *others = find_models(path)
    if others:
        _LOG.warning(
            "%s: the first of %d models, %s, is used; if another has more images, move this one "
            "out of the capture.",
            folder.parent,
            1 + len(others),
            folder.name,
        )
    model = read_colmap(folder)
    calibration = match_clips(path, folder, clips, model.images)
    return replace(calibration, points=model.points, point_colors=model.point_colors)


READER = Reader(
    "COLMAP", ("sparse/0", "sparse"), lambda path: bool(find_models(path)), _read_calibration
)

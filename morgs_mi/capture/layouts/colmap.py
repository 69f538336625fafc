"""COLMAP's sparse models: reader for text and binary files, writer for text.

A model is a folder of cameras, images and points3D (newer versions add rigs and frames, which repeat the
poses). COLMAP's pixel centres lie at +0.5 and its axes are OpenCV's, as in `Camera`, so no axis is flipped.

The reader does not use pycolmap because pycolmap 4.2 never returns from a truncated binary file
and silently drops every second image of a text model without blank lines.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.capture.layouts.calibration import Calibration, Layout, match_clips, required_clips
from morgs_mi.capture.lens import MODELS, Lens, lens_and_intrinsics
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import LARGEST, bounded
from morgs_mi.core.files import write_error
from morgs_mi.io.bounded import check_claim, read_bytes, regular

if TYPE_CHECKING:
    import pycolmap

__all__ = ["LAYOUT", "ColmapModel", "find_colmap", "read_colmap", "write_colmap", "write_reconstruction"]

_FILES = ("cameras", "images", "points3D")
# More values than a line of any camera model has in a text file.
_MAX_CAMERA_FIELDS = 20
# Memory of a `Camera`, which a line of a few characters may describe.
_CAMERA_BYTES = 500


@dataclass(frozen=True)
class ColmapModel:
    """A COLMAP model, before undistortion.

    Attributes:
        cameras: one camera per image in the order of the file; `name` is the name of the image.
        lenses: one lens per camera.
        points: [P, 3] float32, world units.
        point_colors: [P, 3] float32 in [0, 1], display-referred.
    """

    cameras: tuple[Camera, ...]
    lenses: tuple[Lens, ...]
    points: np.ndarray
    point_colors: np.ndarray


def find_colmap(folder: Path) -> Path | None:
    """Return the folder of the COLMAP model in a capture, or None.

    It is the first of `sparse/0`, `sparse`, `colmap/sparse/0` and the folder itself that holds a model.
    """
    for place in (folder / "sparse" / "0", folder / "sparse", folder / "colmap" / "sparse" / "0"):
        if any((place / f"cameras.{kind}").exists() for kind in ("bin", "txt")):
            return place
    # In the capture folder itself all three files are required: a single name may have another meaning.
    here = any(all((folder / f"{name}.{kind}").exists() for name in _FILES) for kind in ("bin", "txt"))
    return folder if here else None


def read_colmap(folder: str | Path) -> ColmapModel:
    """Read the COLMAP model in `folder`, binary if present, otherwise text.

    Raises:
        FileNotFoundError: one of the three files is missing.
        ValueError: a file is broken, refers to a missing camera, or holds an invalid pose or an unsupported lens.
    """
    folder = Path(folder)
    kind = "bin" if (folder / "cameras.bin").exists() else "txt"
    for name in _FILES:
        if not (folder / f"{name}.{kind}").exists():
            raise FileNotFoundError(
                f"{folder}: a COLMAP model needs cameras, images and points3D (.txt or .bin), "
                f"{name}.{kind} is missing; export the whole model."
            )
    cameras_path, images_path, points_path = (folder / f"{name}.{kind}" for name in _FILES)
    text = kind == "txt"
    intrinsics = {}
    for camera_id, model, width, height, params in (_text_cameras if text else _binary_cameras)(cameras_path):
        try:
            intrinsics[camera_id] = (*lens_and_intrinsics(model, params), width, height)
        except ValueError as error:
            raise ValueError(f"{cameras_path}: camera {camera_id}: {error}") from None
        check_claim(cameras_path, _CAMERA_BYTES * len(intrinsics), f"{len(intrinsics)} cameras")
    cameras, lenses = [], []
    for name, camera_id, pose in (_text_images if text else _binary_images)(images_path):
        if camera_id not in intrinsics:
            raise ValueError(
                f"{images_path}: image {name!r} refers to camera {camera_id}, {cameras_path.name} has "
                f"{sorted(intrinsics)}; export both files from the same model."
            )
        lens, K, width, height = intrinsics[camera_id]
        try:
            cameras.append(Camera(K, _viewmat(pose), width, height, name))
        except ValueError as error:
            raise ValueError(f"{images_path}, image {name!r}: {error}") from None
        lenses.append(lens)
        check_claim(images_path, _CAMERA_BYTES * len(cameras), f"{len(cameras)} images")
    if not cameras:
        raise ValueError(f"{images_path}: expected at least one image, got none; register the images.")
    rows = (_text_points if text else _binary_points)(points_path)
    points = np.asarray(np.fromiter(rows, np.dtype((np.float64, 6))), np.float64)
    if not bounded(points):
        raise ValueError(
            f"{points_path}: the points must be finite and at most {LARGEST:g}, got others; export the model again."
        )
    return ColmapModel(
        tuple(cameras),
        tuple(lenses),
        points[:, :3].astype(np.float32),
        (points[:, 3:] / 255).astype(np.float32),
    )


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
        cameras: the views; the image of a view is called `name`, with ``.png`` added if it has no suffix.
        points: [P, 3] world units, or None for no points.
        point_colors: [P, 3] in [0, 1]; grey if None.
        lenses: one per camera, as in `ColmapModel`; pinholes if None.

    Raises:
        OSError: a file could not be written.
    """
    import pycolmap  # takes 0.3 s to import, and only the writer needs it

    model = pycolmap.Reconstruction()
    lenses = [Lens()] * len(cameras) if lenses is None else lenses
    for i, (camera, lens) in enumerate(zip(cameras, lenses, strict=True), start=1):
        K, one_focal = camera.K, lens.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        focals = [K[0, 0]] if one_focal else [K[0, 0], K[1, 1]]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=i,
                model=lens.model,
                width=camera.width,
                height=camera.height,
                params=[*focals, K[0, 2], K[1, 2], *lens.distortion],
            )
        )
        name = camera.name if Path(camera.name).suffix else f"{camera.name}.png"
        pose = pycolmap.Rigid3d(np.asarray(camera.viewmat, dtype=np.float64)[:3])
        model.add_image_with_trivial_frame(pycolmap.Image(image_id=i, camera_id=i, name=name), pose)
    points = np.zeros((0, 3)) if points is None else np.asarray(points)
    colors = np.full(points.shape, 0.5) if point_colors is None else np.asarray(point_colors)
    bytes_ = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
    for xyz, rgb in zip(points, bytes_, strict=True):
        model.add_point3D(xyz.astype(np.float64), pycolmap.Track(), rgb)
    write_reconstruction(model, folder)


def write_reconstruction(model: pycolmap.Reconstruction, folder: str | Path) -> None:
    """Write all files of a model as text, or none; the folder is created if it is missing.

    Raises:
        OSError: a file could not be written.
    """
    folder = Path(folder)
    images, frames = model.num_reg_images(), model.num_reg_frames()
    lines = {"rigs": model.num_rigs(), "frames": frames, "images": 2 * images, "points3D": model.num_points3D()}
    lines["cameras"] = model.num_cameras()  # the last one that is renamed, because readers look for it
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".partial-", dir=folder) as partial:
            model.write_text(partial)
            for name, count in lines.items():
                _check_written(Path(partial) / f"{name}.txt", count)
            for name in lines:
                (Path(partial) / f"{name}.txt").replace(folder / f"{name}.txt")
    except (OSError, RuntimeError, ValueError) as error:
        raise write_error(f"{folder}: the COLMAP model could not be written", error, folder) from error


def _check_written(file: Path, expected: int) -> None:
    """Check that a text file reached the disk with all its lines: pycolmap does not report a full disk.

    Raises:
        OSError: it did not.
    """
    with file.open("rb") as opened:
        os.fsync(opened.fileno())
        written = [line for line in opened if not line.startswith(b"#")]
    if len(written) != expected or (written and not written[-1].endswith(b"\n")):
        raise OSError(f"{file.name} was cut off after {len(written)} of {expected} lines")


def _viewmat(pose: Sequence[float]) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of a wxyz quaternion and a translation."""
    quat, t = np.array(pose[:4]), np.array(pose[4:])
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose must be finite, got {[*pose]}; export the model again.")
    # COLMAP writes unit quaternions.
    if not abs(np.linalg.norm(quat) - 1) <= 1e-2:
        raise ValueError(f"its quaternion must have length 1, got {quat.tolist()}; check the order of the columns.")
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix(), t
    return viewmat


def _read_calibration(path: Path) -> Calibration:
    clips, folder = required_clips(path), find_colmap(path)
    assert folder is not None
    model = read_colmap(folder)
    return Calibration(*match_clips(path, folder, clips, model.cameras, model.lenses), model.points, model.point_colors)


LAYOUT = Layout("COLMAP", ("sparse/0", "sparse"), lambda path: find_colmap(path) is not None, _read_calibration)


# ---- text ------------------------------------------------------------------------------------------------


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and the text of all lines that are not comments, including blank ones."""
    with regular(path).open(encoding="utf-8", errors="replace") as file:
        for i, line in enumerate(file, start=1):
            if not line.startswith("#"):
                yield i, line.rstrip("\n")


def _broken(path: Path, number: int, expected: str, line: str) -> ValueError:
    return ValueError(f"{path}, line {number}: expected `{expected}`, got {line[:80]!r}; export the model again.")


def _text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    for number, line in _lines(path):
        if fields := line.split(maxsplit=_MAX_CAMERA_FIELDS):
            try:
                camera_id, width, height = int(fields[0]), int(fields[2]), int(fields[3])
                yield camera_id, fields[1], width, height, [float(f) for f in fields[4:]]
            except (ValueError, IndexError):
                raise _broken(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", line) from None


def _text_images(path: Path) -> Iterator[tuple[str, int, list[float]]]:
    lines = _lines(path)
    for number, line in lines:
        if not line.strip():
            continue
        fields = line.split(maxsplit=9)
        try:
            name, camera_id, pose = fields[9].strip(), int(fields[8]), [float(f) for f in fields[1:8]]
        except (ValueError, IndexError):
            raise _broken(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line) from None
        number, line = next(lines, (number, ""))
        if _count_words(line) % 3:
            raise _broken(path, number, "POINTS2D[] as (X, Y, POINT3D_ID), or a blank line", line)
        yield name, camera_id, pose


def _count_words(line: str) -> int:
    """Return the length of `line.split()`, which would take many times the memory of a line of thousands of points."""
    visible = np.frombuffer(f" {line}".encode(), np.uint8) > 32
    return int(np.count_nonzero(visible[1:] & ~visible[:-1]))


def _text_points(path: Path) -> Iterator[list[float]]:
    for number, line in _lines(path):
        if fields := line.split(maxsplit=8):
            try:
                xyz_rgb = [float(f) for f in fields[1:7]]
                float(fields[7])
            except (ValueError, IndexError):
                raise _broken(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK[]", line) from None
            yield xyz_rgb


# ---- binary ----------------------------------------------------------------------------------------------


class _Bytes:
    """A binary file that is read sequentially; reads past its end raise ValueError."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        """Return the fields of one little-endian record."""
        layout = "<" + layout
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, self.at - struct.calcsize(layout))

    def skip(self, count: int) -> None:
        if count > len(self.data) - self.at:
            raise ValueError(
                f"{self.path}: expected {count} more bytes at byte {self.at}, got "
                f"{len(self.data) - self.at}: the file is truncated or broken; export the model again."
            )
        self.at += count

    def string(self) -> str:
        start, end = self.at, self.data.find(b"\0", self.at)
        self.skip((end if end >= 0 else len(self.data)) + 1 - start)
        return self.data[start:end].decode("utf-8", errors="replace")


def _binary_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    file, names = _Bytes(path), list(MODELS)
    for _ in range(*file.take("Q")):
        camera_id, model, width, height = file.take("IiQQ")
        if not 0 <= model < len(names):
            # lens_and_intrinsics rejects this name; the rest of the file cannot be read.
            yield camera_id, f"number {model}", width, height, ()
            return
        focals, coefficients = MODELS[names[model]]
        yield camera_id, names[model], width, height, file.take(f"{focals + 2 + coefficients}d")


def _binary_images(path: Path) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    file = _Bytes(path)
    for _ in range(*file.take("Q")):
        _, *pose, camera_id = file.take("I7dI")
        name = file.string()
        (count,) = file.take("Q")
        file.skip(24 * count)
        yield name, camera_id, tuple(pose)


def _binary_points(path: Path) -> Iterator[list[float]]:
    file = _Bytes(path)
    for _ in range(*file.take("Q")):
        _, *xyz_rgb, _, track = file.take("Q3d3BdQ")
        file.skip(8 * track)
        yield xyz_rgb

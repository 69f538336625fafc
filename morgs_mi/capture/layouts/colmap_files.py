"""The files of a COLMAP model, as text and binary.

A text file has a record in each line, apart from comments (#). A binary file has the number of its
records as uint64, and then the records, little-endian:

    cameras.txt     CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]
    cameras.bin     uint32 id, int32 model, uint64 width, uint64 height, float64 parameters

    images.txt      IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME
                    POINTS2D[] as (X, Y, POINT3D_ID), or a blank line
    images.bin      uint32 id, float64 pose [7], uint32 camera, name and a byte 0,
                    uint64 number of points, 24 bytes each

    points3D.txt    POINT3D_ID X Y Z R G B ERROR TRACK[]
    points3D.bin    uint64 id, float64 x y z, uint8 r g b, float64 error,
                    uint64 length of the track, 8 bytes each

Readers yield a tuple per record: id, model, width, height and parameters of a camera; name, id of
the camera and pose [7] of an image, a wxyz quaternion and a translation; x, y, z and the colour, 0
to 255, of a point.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from morgs_mi.capture.lens import MODELS
from morgs_mi.platform.bounded import read_bytes, regular

# The records, as in the module's docstring: lines of text, and the formats of `struct`.
_CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
_CAMERA_BYTES = "<IiQQ"
_IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_IMAGE_BYTES = "<I7dI"
_IMAGE_POINTS = "POINTS2D[] as (X, Y, POINT3D_ID), or a blank line"
_POINT = "POINT3D_ID X Y Z R G B ERROR TRACK[]"
_POINT_BYTES = "<Q3d3BdQ"
_COUNT = "<Q"
# More values than a line of any camera model has in a text file.
_MAX_CAMERA_FIELDS = 20


def model_file(folder: Path, name: str) -> Path:
    """Return the path of a file of a COLMAP model, which may be missing: binary if its cameras are,
    otherwise text.
    """
    kind = "bin" if (folder / "cameras.bin").exists() else "txt"
    return folder / f"{name}.{kind}"


def read_cameras(path: Path) -> Iterator[tuple[int, str, int, int, Sequence[float]]]:
    """Yield (camera id, model, width, height, parameters) of each row of `cameras.bin` or
    `cameras.txt`; ValueError: a row is broken.
    """
    return _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)


def read_images(path: Path) -> Iterator[tuple[str, int, Sequence[float]]]:
    """Yield the name, the id of the camera and the pose of each image of `images.bin` or
    `images.txt`: quaternion (w, x, y, z) and translation, world to camera [7].
    """
    return _binary_images(path) if path.suffix == ".bin" else _text_images(path)


def read_points(path: Path) -> Iterator[list[float]]:
    """Yield the position and the colour, 0 to 255, of each point of `points3D.bin` or
    `points3D.txt` [6].
    """
    return _binary_points(path) if path.suffix == ".bin" else _text_points(path)


# ---- text ----------------------------------------------------------------------------------------


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and the text of all lines but comments, blank lines included."""
    with regular(path).open(encoding="utf-8-sig", errors="replace") as file:
        for i, line in enumerate(file, start=1):
            if not line.startswith("#"):
                yield i, line.rstrip("\n")


@contextmanager
def _expected(record: str, path: Path, number: int, line: str) -> Iterator[None]:
    """Name the line and the record that it should hold in an error of reading it."""
    try:
        yield
    except (ValueError, IndexError):
        raise ValueError(
            f"{path}, line {number}: expected `{record}`, got {line[:80]!r}; export it again."
        ) from None


def _text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    for number, line in _lines(path):
        if fields := line.split(maxsplit=_MAX_CAMERA_FIELDS):
            with _expected(_CAMERA, path, number, line):
                camera_id, width, height = (int(fields[k]) for k in (0, 2, 3))
                params = [float(f) for f in fields[4:]]
            yield camera_id, fields[1], width, height, params


def _text_images(path: Path) -> Iterator[tuple[str, int, list[float]]]:
    lines = _lines(path)
    for number, line in lines:
        if not line.strip():
            continue
        with _expected(_IMAGE, path, number, line):
            fields = line.rstrip().split(maxsplit=8)
            pose = [float(f) for f in fields[1:8]]
            # The name may begin with spaces.
            camera_id, name = re.split(r"\s", fields[8], maxsplit=1)
            camera_id = int(camera_id)
        number, line = next(lines, (number, ""))
        # line.split() would take many times the memory of a line of thousands of points.
        visible = np.frombuffer(f" {line}".encode(), np.uint8) > 32
        with _expected(_IMAGE_POINTS, path, number, line):
            if np.count_nonzero(visible[1:] & ~visible[:-1]) % 3:
                raise ValueError
        yield name, camera_id, pose


def _text_points(path: Path) -> Iterator[list[float]]:
    for number, line in _lines(path):
        if fields := line.split(maxsplit=8):
            with _expected(_POINT, path, number, line):
                xyz_rgb = [float(f) for f in fields[1:7]]
                float(fields[7])  # the error, which must be a number
            yield xyz_rgb


# ---- binary --------------------------------------------------------------------------------------


class _Bytes:
    """A binary file that is read sequentially; reads past its end raise ValueError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.at = 0

    def records(self, what: str) -> Iterator[None]:
        """Yield once for each record that the file announces, and check that nothing follows."""
        (count,) = self.take(_COUNT)
        for _ in range(count):
            yield
        if rest := len(self.data) - self.at:
            raise ValueError(
                f"{self.path}: expected the {count} {what} it announces, got {rest} more bytes; "
                "copy it again."
            )

    def take(self, record: str) -> tuple:
        """Return the fields of a record, by its format."""
        start = self.at
        self.skip(struct.calcsize(record))
        return struct.unpack_from(record, self.data, start)

    def skip(self, count: int) -> None:
        if count > (rest := len(self.data) - self.at):
            raise ValueError(
                f"{self.path}: expected {count} more bytes at byte {self.at}, got {rest}; copy it "
                "again."
            )
        self.at += count

    def string(self) -> str:
        start = self.at
        end = self.data.find(b"\0", start)
        self.skip((end if end >= 0 else len(self.data)) + 1 - start)
        return self.data[start:end].decode("utf-8", errors="replace")


def _binary_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    file = _Bytes(path)
    names = dict(enumerate(MODELS))
    for _ in file.records("cameras"):
        camera_id, model, width, height = file.take(_CAMERA_BYTES)
        # The caller refuses another model by its name.
        name = names.get(model, f"number {model}")
        yield camera_id, name, width, height, file.take(f"<{2 + sum(MODELS.get(name, ()))}d")


def _binary_images(path: Path) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    file = _Bytes(path)
    for _ in file.records("images"):
        _, *pose, camera_id = file.take(_IMAGE_BYTES)
        name = file.string()
        (points,) = file.take(_COUNT)
        file.skip(24 * points)
        yield name, camera_id, tuple(pose)


def _binary_points(path: Path) -> Iterator[list[float]]:
    file = _Bytes(path)
    for _ in file.records("points"):
        _, *xyz_rgb, _, track = file.take(_POINT_BYTES)
        file.skip(8 * track)
        yield xyz_rgb

"""The files of a COLMAP model, as text and binary.

Readers yield a tuple per record: id, model, width, height and parameters of a camera; name, id of
the camera and pose [7] of an image, a wxyz quaternion and a translation; x, y, z and the colour, 0
to 255, of a point.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from morgs_mi.capture.lens import MODELS
from morgs_mi.core.bounded import read_bytes, regular

# The least bytes of an image in a binary model.
_IMAGE_BYTES = 73
# What precedes the name of an image in a line of text: nine words, and one space. The name may
# begin with spaces.
_BEFORE_NAME = re.compile(r"\s*(?:\S+\s+){8}\S+\s")
# More values than a line of any camera model has in a text file.
_MAX_CAMERA_FIELDS = 20


def count_images(folder: Path) -> int:
    """Return the number of images in the COLMAP model in `folder`; 0 if it cannot be read."""
    with suppress(OSError, ValueError):
        if (folder / "cameras.bin").exists():
            file = _Bytes(folder / "images.bin")
            (count,) = file.take("Q")
            return min(count, len(file.data) // _IMAGE_BYTES)
        return sum(1 for _ in text_images(folder / "images.txt"))
    return 0


# ---- text ----------------------------------------------------------------------------------------


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number, from 1, and the text of all lines that are not comments, including blank
    ones.
    """
    with regular(path).open(encoding="utf-8-sig", errors="replace") as file:
        for i, line in enumerate(file, start=1):
            if not line.startswith("#"):
                yield i, line.rstrip("\n")


def _broken(path: Path, number: int, expected: str, line: str) -> ValueError:
    return ValueError(
        f"{path}, line {number}: expected `{expected}`, got {line[:80]!r}; export the model again."
    )


def text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    for number, line in _lines(path):
        if fields := line.split(maxsplit=_MAX_CAMERA_FIELDS):
            try:
                camera_id, width, height = (int(fields[k]) for k in (0, 2, 3))
                params = [float(f) for f in fields[4:]]
            except (ValueError, IndexError):
                raise _broken(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", line) from None
            yield camera_id, fields[1], width, height, params


def text_images(path: Path) -> Iterator[tuple[str, int, list[float]]]:
    lines = _lines(path)
    for number, line in lines:
        if not line.strip():
            continue
        try:
            fields = line.split(maxsplit=9)
            camera_id = int(fields[8])
            pose = [float(f) for f in fields[1:8]]
            name = _BEFORE_NAME.sub("", line, count=1).rstrip() if fields[9] else ""
        except (ValueError, IndexError):
            raise _broken(
                path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line
            ) from None
        number, line = next(lines, (number, ""))
        # line.split() would take many times the memory of a line of thousands of points.
        visible = np.frombuffer(f" {line}".encode(), np.uint8) > 32
        if np.count_nonzero(visible[1:] & ~visible[:-1]) % 3:
            raise _broken(path, number, "POINTS2D[] as (X, Y, POINT3D_ID), or a blank line", line)
        yield name, camera_id, pose


def text_points(path: Path) -> Iterator[list[float]]:
    for number, line in _lines(path):
        if fields := line.split(maxsplit=8):
            try:
                xyz_rgb = [float(f) for f in fields[1:7]]
                float(fields[7])  # the error, which must be a number
            except (ValueError, IndexError):
                raise _broken(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK[]", line) from None
            yield xyz_rgb


# ---- binary --------------------------------------------------------------------------------------


class _Bytes:
    """A binary file that is read sequentially; reads past its end raise ValueError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.at = 0

    def take(self, layout: str) -> tuple:
        """Return the fields of one little-endian record."""
        layout = "<" + layout
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, self.at - struct.calcsize(layout))

    def skip(self, count: int) -> None:
        if count > (rest := len(self.data) - self.at):
            raise ValueError(
                f"{self.path}: expected {count} more bytes at byte {self.at}, got {rest}: the file "
                "is truncated or broken; export the model again."
            )
        self.at += count

    def end(self, count: int, what: str) -> None:
        """Check that nothing follows the `count` records that the file announces."""
        if rest := len(self.data) - self.at:
            raise ValueError(
                f"{self.path}: expected the {count} {what} that it announces, got {rest} more "
                "bytes: the number or the file is broken; export the model again."
            )

    def string(self) -> str:
        start = self.at
        end = self.data.find(b"\0", self.at)
        self.skip((end if end >= 0 else len(self.data)) + 1 - start)
        return self.data[start:end].decode("utf-8", errors="replace")


def binary_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    file = _Bytes(path)
    names = list(MODELS)
    (count,) = file.take("Q")
    for _ in range(count):
        camera_id, model, width, height = file.take("IiQQ")
        if not 0 <= model < len(names):
            # lens_and_intrinsics rejects this name; the rest of the file cannot be read.
            yield camera_id, f"number {model}", width, height, ()
            return
        params = file.take(f"{2 + sum(MODELS[names[model]])}d")
        yield camera_id, names[model], width, height, params
    file.end(count, "cameras")


def binary_images(path: Path) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    for _ in range(count):
        _, *pose, camera_id = file.take("I7dI")
        name = file.string()
        (points,) = file.take("Q")
        file.skip(24 * points)
        yield name, camera_id, tuple(pose)
    file.end(count, "images")


def binary_points(path: Path) -> Iterator[list[float]]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    for _ in range(count):
        _, *xyz_rgb, _, track = file.take("Q3d3BdQ")
        file.skip(8 * track)
        yield xyz_rgb
    file.end(count, "points")

"""EXR files: float32 channels with the names of the renderer's AOVs (`motion.X`, ...), and images
in linear light.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import OpenEXR

from morgs_mi.core.bounded import check_claim
from morgs_mi.core.color_space import positive_light
from morgs_mi.core.files import atomic_path

_MAGIC = 20000630
_MULTIPART = 1 << 12
# Chromaticities of Rec. 709, the default of EXR files: x and y of red, green, blue and white.
_REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
# Largest difference of chromaticities that counts as equal.
_SAME = 1e-3


def write_exr(path: str | Path, channels: Mapping[str, np.ndarray]) -> None:
    """Write `channels`, each [H, W], as one float32 EXR file, atomically.

    Raises:
        ValueError: there is no channel, or the channels differ in shape.
        OSError: the file cannot be written.
    """
    _check_shapes(channels)
    pixels = {name: np.ascontiguousarray(channel, np.float32) for name, channel in channels.items()}
    with atomic_path(path, "write_exr()") as partial:
        _write(partial, pixels)


def _write(path: Path, pixels: dict[str, np.ndarray]) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, pixels).write(str(path))
    except RuntimeError as error:
        raise OSError(str(error)) from error


def _check_shapes(channels: Mapping[str, np.ndarray]) -> None:
    shapes = {name: np.shape(channel) for name, channel in channels.items()}
    if len(set(shapes.values())) != 1 or any(len(shape) != 2 for shape in shapes.values()):
        raise ValueError(
            f"write_exr(): `channels` must share one shape [H, W], got {shapes}; pass one image "
            "each."
        )


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """Return the channels of an EXR file by name, each [H, W] as float32.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: it is not a readable EXR file, or claims more pixels than fit its size.
    """
    return _read(path)[0]


def read_light(path: str | Path) -> np.ndarray:
    """Return the image of an EXR file [H, W, 3], float32 in linear light with Rec. 709 primaries,
    not negative.

    Its channels are R, G, B, or Y alone. Other primaries, which the attribute `chromaticities`
    names, are converted by colour-science, with Bradford's adaptation to another white.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: as for `read_exr`.
        ValueError: it has other channels, or values that are not finite.
    """
    channels, primaries = _read(path)
    light = np.stack([channels[name] for name in _color_names(path, channels)], axis=-1)
    if np.abs(np.subtract(primaries, _REC_709)).max() > _SAME:
        light = light @ _to_rec_709(primaries).T
    return positive_light(light, f"{path}: its image")


def _color_names(path: str | Path, channels: Mapping[str, np.ndarray]) -> str:
    """Return the names of the channels of red, green and blue."""
    names = "RGB" if {"R", "G", "B"} <= channels.keys() else "YYY"
    if not set(names) <= channels.keys():
        raise ValueError(
            f"{path}: expected the channels R, G, B, or Y, got {', '.join(channels)}; rename them."
        )
    return names


def _to_rec_709(primaries: Sequence[float]) -> np.ndarray:
    """Return the matrix [3, 3] that converts linear RGB from primaries in the form of `_REC_709` to
    Rec. 709.
    """
    # The import takes a second, for which other images should not wait.
    from colour import RGB_Colourspace, matrix_RGB_to_RGB

    spaces = (
        RGB_Colourspace("", np.reshape(xy[:6], (3, 2)), np.array(xy[6:]))
        for xy in (primaries, _REC_709)
    )
    return matrix_RGB_to_RGB(*spaces, chromatic_adaptation_transform="Bradford").astype(np.float32)


def _read(path: str | Path) -> tuple[dict[str, np.ndarray], Sequence[float]]:
    """Return the channels of an EXR file by name, and its primaries and white, see `_REC_709`."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"read_exr(): there is no file {path}; check the path.")
    try:
        _check_size(path)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {
                name: np.asarray(channel.pixels, np.float32)
                for name, channel in file.channels().items()
            }
            return channels, file.header().get("chromaticities", _REC_709)
    except (RuntimeError, ValueError, KeyError, struct.error) as error:
        raise OSError(
            f"read_exr(): cannot read {path}: {error}; the file may be truncated."
        ) from error


def _check_size(path: str | Path) -> None:
    """Check the sizes in the headers of all parts, which OpenEXR allocates even where it reads the
    headers alone.
    """
    with Path(path).open("rb") as file:
        sizes = list(map(_part_size, _headers(file)))
    numbers = sum(width * height * channels for width, height, channels in sizes)
    content = " and ".join(f"{w}x{h} pixels of {n} channels" for w, h, n in sizes)
    check_claim(path, 4 * numbers, content)


def _headers(file: BinaryIO) -> list[dict[bytes, bytes]]:
    """Return the attributes of all parts."""
    magic, version = struct.unpack("<II", file.read(8).ljust(8, b"\0"))
    if magic != _MAGIC:
        raise ValueError("it does not begin with the number of an EXR file")
    parts = [_header(file)]
    # Headers of several parts end with an empty one.
    while version & _MULTIPART and (header := _header(file)):
        parts.append(header)
    return parts


def _part_size(part: Mapping[bytes, bytes]) -> tuple[int, int, int]:
    """Return the width, the height and the number of channels of a part."""
    left, top, right, bottom = struct.unpack("<4i", part[b"dataWindow"])
    channels = _count_channels(part[b"channels"])
    if part.get(b"type", b"").startswith(b"deep"):
        raise ValueError("it has deep pixels, which are not supported")
    return max(0, right - left + 1), max(0, bottom - top + 1), channels


def _header(file: BinaryIO) -> dict[bytes, bytes]:
    """Return the attributes of one part."""
    attributes = {}
    while name := _string(file):
        _string(file)
        (size,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
        attributes[name] = file.read(size)
    return attributes


def _count_channels(data: bytes) -> int:
    count = at = 0
    while at < len(data) - 1:
        at = data.index(b"\0", at) + 17  # a name that ends in 0, and 16 bytes
        count += 1
    return count


def _string(file: BinaryIO) -> bytes:
    return b"".join(iter(lambda: file.read(1).strip(b"\0"), b""))

"""EXR files: float32 channels with the names of the renderer's AOVs (`motion.X`, ...), and images
in linear light.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

from morgs_mi.core.color_space import positive_light
from morgs_mi.core.types import Arrays
from morgs_mi.io.listing import existing_file
from morgs_mi.platform.bounded import check_claim
from morgs_mi.platform.checks import few, require
from morgs_mi.platform.files import atomic_path

# Chromaticities of Rec. 709, the default of EXR files: x and y of red, green, blue and white.
_REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
# Chromaticities, pixel aspects and alphas that differ by less count as equal; a half float near 1
# is rounded by up to 5e-4.
_SAME = 1e-3
# Attributes of a header, by their names, types and sizes. A channel has a name that ends in 0, and
# 16 bytes, of which the last 8 are the sampling.
_WINDOW = re.compile(rb"(?:data|display)Window\0box2i\0\x10\0\0\0(.{16})", re.DOTALL)
_CHANNELS = re.compile(rb"channels\0chlist\0(.{4})", re.DOTALL)
_CHANNEL = re.compile(rb"([^\0]+)\0.{8}(.{8})", re.DOTALL)
_DEEP = re.compile(rb"type\0string\0.{4}deep", re.DOTALL)


def write_exr(path: str | Path, channels: Arrays) -> None:
    """Write `channels`, each [H, W], as one float32 EXR file, atomically.

    Raises:
        OSError: the file cannot be written.
    """
    pixels = {name: np.ascontiguousarray(channel, np.float32) for name, channel in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path, "write_exr()") as partial:
        try:
            OpenEXR.File(header, pixels).write(str(partial))
        except RuntimeError as error:
            raise OSError(str(error)) from error


def read_exr(path: str | Path) -> Arrays:
    """Return the channels of an EXR file by name, each [H, W] as float32: its display window, with
    0 where no pixel is stored.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: it is not a readable EXR file, or claims more pixels than fit its size.
    """
    return _read(path)[0]


def read_light(path: str | Path) -> np.ndarray:
    """Return the image of an EXR file [H, W, 3], float32 in linear light with Rec. 709 primaries,
    not negative.

    The file has the channels R, G, B, or Y alone. Other primaries, which the attribute
    `chromaticities` names, are converted by colour-science, with Bradford's adaptation to another
    white.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: as for `read_exr`.
        ValueError: it has other channels, pixels that are not square, or values that are not
            finite.
    """
    channels, header = _read(path)
    if abs((aspect := header.get("pixelAspectRatio", 1)) - 1) > _SAME:
        raise ValueError(
            f"{path}: expected square pixels, got the pixel aspect {aspect:g}; resample the image."
        )
    light = np.stack([channels[name] for name in _color_names(path, channels)], axis=-1)
    primaries = header.get("chromaticities", _REC_709)
    if np.abs(np.subtract(primaries, _REC_709)).max() > _SAME:
        # The import takes a second, for which other images should not wait.
        from colour import RGB_Colourspace, matrix_RGB_to_RGB

        spaces = (
            RGB_Colourspace("", np.reshape(xy[:6], (3, 2)), np.array(xy[6:]))
            for xy in (primaries, _REC_709)
        )
        matrix = matrix_RGB_to_RGB(*spaces, chromatic_adaptation_transform="Bradford")
        light = light @ matrix.astype(np.float32).T
    return positive_light(light, f"{path}: its image")


def opaque_light(path: str | Path) -> np.ndarray:
    """Return the mask [H, W] of the pixels that are stored and opaque, bool.

    Raises:
        FileNotFoundError, OSError: as for `read_exr`.
    """
    channels, header = _read(path)
    left_top, right_bottom = header["dataWindow"]
    stored = _displayed(np.ones((right_bottom - left_top + 1)[::-1]), header)
    return channels.get("A", stored) > 1 - _SAME


def _color_names(path: str | Path, channels: Arrays) -> tuple[str, str, str]:
    """Return the names of the channels of red, green and blue."""
    names = ("R", "G", "B") if "R" in channels else ("Y", "Y", "Y")
    require(
        {*names} <= channels.keys(),
        path,
        "expected the channels R, G, B, or Y",
        few([*channels]),
        "save the colours without layers (in Blender as OpenEXR, not as OpenEXR MultiLayer)",
    )
    return names


def _read(path: str | Path) -> tuple[Arrays, dict[str, Any]]:
    """Return the channels of an EXR file by name, and its header."""
    existing_file(path, "an EXR file")
    try:
        _check_size(path)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header = dict(file.header())  # the file clears its own
            channels = {
                name: _displayed(np.asarray(channel.pixels, np.float32), header)
                for name, channel in file.channels().items()
            }
            return channels, header
    except (RuntimeError, ValueError, struct.error) as error:
        raise OSError(f"cannot read {path}: {error}; the file may be truncated.") from error


def _displayed(pixels: np.ndarray, header: Mapping[str, Any]) -> np.ndarray:
    """Return the display window [H, W] of the pixels in the data window, 0 where there are none."""
    left_top, right_bottom = header["displayWindow"]
    shift = header["dataWindow"][0] - left_top
    size = (right_bottom - left_top + 1).tolist()
    if not shift.any() and pixels.shape[::-1] == tuple(size):
        return pixels
    return cv2.warpAffine(pixels, np.c_[np.eye(2), shift], size, flags=cv2.INTER_NEAREST)


def _check_size(path: str | Path) -> None:
    """Check the sizes in the headers of all parts, which OpenEXR allocates even where it reads the
    headers alone.
    """
    data = Path(path).read_bytes()
    windows = np.frombuffer(b"".join(_WINDOW.findall(data)), "<i4").reshape(-1, 2, 2)
    if _DEEP.search(data):
        raise ValueError("it has deep pixels, which are not supported")
    if len(windows) < 2:
        raise ValueError("its header lacks dataWindow or displayWindow")
    width, height = (np.diff(windows.astype(np.int64), axis=1).max(axis=0) + 1).ravel().tolist()
    num_channels = 0
    for start in _CHANNELS.finditer(data):
        (size,) = struct.unpack("<I", start[1])
        channels = _CHANNEL.findall(data[start.end() : start.end() + size])
        num_channels += len(channels)
        for name, sampling in channels:
            if sampling != b"\1\0\0\0" * 2:
                raise ValueError(f"its channel {name.decode()} has fewer numbers than pixels")
    content = f"{width}x{height} pixels of {num_channels} channels"
    check_claim(path, 4 * width * height * num_channels, content)

"""Size of an image from the header of its file: PNG, JPEG, TIFF, WebP and BMP."""

from __future__ import annotations

import struct

import numpy as np

# Bytes of a JPEG file in which its size is searched.
_MAX_HEADER = 1_000_000

# Tags of the width and the height of a TIFF image, and the formats of the numbers that store them,
# by type.
_TIFF_SIZE = {256: 0, 257: 1}
_TIFF_TYPES = {3: "H", 4: "I", 16: "Q"}


def image_size(data: np.ndarray) -> tuple[int, int]:
    """Return the width and height in the bytes of an image file, uint8 [N]; 0, 0 of another file or
    a broken header.
    """
    content = data.data
    start = bytes(content[:4])
    for magic, read in _FORMATS.items():
        if start.startswith(magic):
            try:
                return read(content)
            except (struct.error, OverflowError):
                return 0, 0
    return 0, 0


def _png(data: memoryview) -> tuple[int, int]:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg(data: memoryview) -> tuple[int, int]:
    at = 2
    while at + 9 <= min(len(data), _MAX_HEADER):
        marker, length = struct.unpack_from(">xBH", data, at)
        # Start of a frame, by its kind of compression; the other three numbers mark tables.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 1 if marker == 0xFF else 2 + length
    return 0, 0


def _bmp(data: memoryview) -> tuple[int, int]:
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)  # a negative height: from top to bottom


def _webp(data: memoryview) -> tuple[int, int]:
    kind = bytes(data[12:16])
    if kind == b"VP8X":
        low_width, high_width, low_height, high_height = struct.unpack_from("<HBHB", data, 24)
        return 1 + low_width + (high_width << 16), 1 + low_height + (high_height << 16)
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return 0, 0


def _tiff(data: memoryview) -> tuple[int, int]:
    order = "<" if bytes(data[:2]) == b"II" else ">"
    large = 43 in bytes(data[2:4])  # BigTIFF: numbers of 8 bytes instead of 4
    size = [0, 0]
    value = 12 if large else 8
    (start,) = struct.unpack_from(order + ("Q" if large else "I"), data, 8 if large else 4)
    (count,) = struct.unpack_from(order + ("Q" if large else "H"), data, start)
    first, length = (start + 8, 20) if large else (start + 2, 12)
    # The entries of the first directory.
    for at in range(first, min(first + length * count, len(data)), length):
        tag, kind = struct.unpack_from(order + "HH", data, at)
        if tag in _TIFF_SIZE and kind in _TIFF_TYPES:
            (size[_TIFF_SIZE[tag]],) = struct.unpack_from(
                order + _TIFF_TYPES[kind], data, at + value
            )
    return size[0], size[1]


_FORMATS = {
    b"\x89PNG": _png,
    b"\xff\xd8": _jpeg,
    b"BM": _bmp,
    b"RIFF": _webp,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), _tiff),
}

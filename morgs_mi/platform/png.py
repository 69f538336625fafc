"""PNG and JPEG files in memory."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

# The signature, and length and name of the first chunk, which begins with width and height.
_START = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_SIZE = struct.Struct(">II")
_CHUNKS = 8  # where they begin
_CHUNK = struct.Struct(">I4s")  # length and name, which its content and a checksum follow
_CRC = 4


@dataclass(frozen=True, eq=False)
class PngImage:
    """RGB image in a PNG file, which is decoded when its pixels are first needed."""

    data: bytes  #: The file.

    @property
    def size(self) -> tuple[int, int]:
        """Width and height that the file claims; zeros for a file that is no PNG."""
        has_size = self.data.startswith(_START) and len(self.data) >= len(_START) + _SIZE.size
        return _SIZE.unpack_from(self.data, len(_START)) if has_size else (0, 0)

    @cached_property
    def pixels(self) -> np.ndarray:
        """The image, uint8 [H, W, 3].

        Raises:
            ValueError: the file is broken.
        """
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        image = None
        if has_whole_chunks(self.data):
            image = cv2.imdecode(np.frombuffer(self.data, np.uint8), flags)
        if image is None:
            raise ValueError("expected a PNG image, got a broken file; write it again.")
        return image


def has_whole_chunks(data: bytes) -> bool:
    """Return whether the chunks of a PNG file, up to its last one, lie within it.

    OpenCV allocates, and writes, what the length of a chunk claims, up to 4 GB.
    """
    at = _CHUNKS
    name = b""
    while name != b"IEND" and at + _CHUNK.size <= len(data):
        length, name = _CHUNK.unpack_from(data, at)
        at += _CHUNK.size + length + _CRC
    return name == b"IEND" and at <= len(data)


def png_bytes(image: np.ndarray) -> bytes:
    """Return an image, uint8 RGB [H, W, 3] or RGBA [H, W, 4], as a PNG file."""
    order = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    return cv2.imencode(".png", cv2.cvtColor(image, order))[1].tobytes()


def jpeg_bytes(image: np.ndarray) -> bytes:
    """Return an image, uint8 RGB [H, W, 3], as a JPEG file."""
    return cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()

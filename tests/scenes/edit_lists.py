"""Clips that are cut by an edit list, as programs do that do not encode them again."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

PER_SECOND = 1000
"""Units of the lengths in an edit list; FFmpeg writes milliseconds."""


def show_parts(path: Path, parts: Sequence[tuple[float, float]]) -> Path:
    """Let an .mp4 or .mov of OpenCV show only parts of itself in succession, given by their starts
    and lengths, s.

    A part with a negative start is a pause.
    """
    data = bytearray(path.read_bytes())
    scale = _number(data, data.index(b"mdhd") + 16)
    box = data.index(b"elst") - 4
    # Time of the first frame in the track: it has later frames before it.
    first = _number(data, box + 20)
    entries = b"".join(
        struct.pack(
            ">IiI",
            round(PER_SECOND * length),
            -1 if start < 0 else first + round(scale * start),
            0x10000,
        )
        for start, length in parts
    )
    grown = 16 + len(entries) - _number(data, box)
    data[box : box + _number(data, box)] = (
        struct.pack(">I4sII", 16 + len(entries), b"elst", 0, len(parts)) + entries
    )
    for parent in (b"moov", b"trak", b"edts"):
        at = data.index(parent) - 4
        data[at : at + 4] = struct.pack(">I", _number(data, at) + grown)
    path.write_bytes(data)
    return path


def _number(data: bytearray, at: int) -> int:
    return struct.unpack(">I", data[at : at + 4])[0]

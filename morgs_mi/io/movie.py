"""Structure of MP4 and QuickTime files: nested boxes, and the edit list, which states the part of a
clip that is shown.

Programs that cut a clip without encoding it again leave the frames in the file and hide them by an
edit list.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

# The boxes with which a file of this kind begins.
_FIRST = {b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"}
# Bytes of an edit list that are read; it has a few entries.
_MAX_EDITS = 1_000_000


@dataclass(frozen=True)
class Movie:
    """An MP4 or QuickTime file."""

    complete: bool  #: Whether the file is as long as its boxes state.
    #: Lengths of the parts of the video that are shown in succession, s; 0: up to its end.
    parts: tuple[float, ...]


@dataclass(frozen=True)
class _Box:
    """A box: its kind, and the place of its content in the file, bytes."""

    kind: bytes
    start: int
    stop: int


def read_movie(path: Path) -> Movie | None:
    """Return the structure of an MP4 or QuickTime file, None for any other file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8)[4:] not in _FIRST:
            return None
        boxes = list(_boxes(file, 0, size))
        movie = next((box for box in boxes if box.kind == b"moov"), None)
        complete = boxes[-1].stop <= size
        return Movie(complete, () if movie is None else _parts(file, movie))


def _parts(file: BinaryIO, movie: _Box) -> tuple[float, ...]:
    """Return the `Movie.parts` of the first track of images, none without an edit list."""
    header = _first(file, movie, b"mvhd")
    track = _image_track(file, movie)
    edits = None if track is None else _first(file, track, b"edts", b"elst")
    if header is None or edits is None:
        return ()
    return _durations(file, edits, _time_scale(file, header))


def _image_track(file: BinaryIO, movie: _Box) -> _Box | None:
    """Return the first track of images."""
    for track in (box for box in _boxes(file, movie.start, movie.stop) if box.kind == b"trak"):
        handler = _first(file, track, b"mdia", b"hdlr")
        if handler is not None and _bytes(file, handler, 12)[8:] == b"vide":
            return track
    return None


def _durations(file: BinaryIO, edits: _Box, per_second: int) -> tuple[float, ...]:
    """Return the lengths of the parts in an edit list, s."""
    data = _bytes(file, edits, _MAX_EDITS)
    # An entry has the length of the part, its start in the track, -1 for a pause, and its speed.
    width = 8 if data[:1] == b"\1" else 4
    places = range(8, len(data) - 2 * width - 3, 2 * width + 4)
    entries = [data[at : at + 2 * width] for at in places]
    return tuple(
        int.from_bytes(entry[:width], "big") / max(per_second, 1)
        for entry in entries
        if int.from_bytes(entry[width:], "big", signed=True) >= 0
    )


def _time_scale(file: BinaryIO, header: _Box) -> int:
    """Return the units of time per second in the header of the file."""
    data = _bytes(file, header, 24)
    at = 20 if data[:1] == b"\1" else 12
    return int.from_bytes(data[at : at + 4], "big")


def _first(file: BinaryIO, box: _Box | None, *kinds: bytes) -> _Box | None:
    """Return the first box at a path of kinds within another, None if there is none."""
    for kind in kinds:
        inner = () if box is None else _boxes(file, box.start, box.stop)
        box = next((b for b in inner if b.kind == kind), None)
    return box


def _boxes(file: BinaryIO, start: int, stop: int) -> Iterator[_Box]:
    """Yield the boxes side by side in a range of a file; the last one may end behind it."""
    while start + 8 <= stop:
        file.seek(start)
        head = file.read(16)
        size = int.from_bytes(head[:4], "big")
        begin = 8
        if size == 1:
            size = int.from_bytes(head[8:], "big")
            begin = 16
        elif size == 0:
            size = stop - start
        yield _Box(head[4:8], start + begin, start + size)
        start += max(size, begin)


def _bytes(file: BinaryIO, box: _Box, count: int) -> bytes:
    """Return the first bytes of a box's content, fewer if it is shorter."""
    file.seek(box.start)
    return file.read(min(count, box.stop - box.start))

"""What can still be played of a damaged stream: all packets are looked for by their CRC, wherever they begin.

Neither lengths nor the index are trusted, so whatever happened to the rest, an intact packet is found. A frame plays if
its packet is intact and its parent plays, or from a keyframe on.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from morgs_mi.codec.container import HEAD, MAGIC, PAYLOAD, PREAMBLE, VERSION, PacketKind, decode_packet, open_packet
from morgs_mi.codec.gaussians import CodedFrame, decode

__all__ = ["Gap", "salvage"]

# A packet begins with its kind, uint32. The header is not looked for: it has its place, and holes are full of zeros.
_KIND = re.compile(rb"[\1-\3]\0\0\0")


@dataclass(frozen=True)
class Gap:
    """Bytes of a stream that give no frame.

    Attributes:
        start: the first of them.
        stop: the first that is none of them.
        problem: what is wrong with them.
    """

    start: int
    stop: int
    problem: str


def salvage(path: str | Path) -> Iterator[CodedFrame | Gap]:
    """Yield what a stream file still says, in its order: the states of frames, and what is damaged or lost.

    A file that is cut off behind a whole packet is shorter and no more: `StreamReader.closed` tells. Cameras are not
    asked for, so frames may be played from under a header that is broken.

    Raises:
        FileNotFoundError: there is no such file.
    """
    data = Path(path).read_bytes()  # a map of the file would end the process if somebody cut it off meanwhile
    if not data:
        yield Gap(0, 0, "the file is empty")
    coded, at = None, 0
    for kind, start, stop in _intact(data):
        if start > at:
            yield Gap(at, start, "the bytes are damaged")
        at = stop
        if kind in (PacketKind.KEYFRAME, PacketKind.RESIDUAL):
            try:
                packet = decode_packet(data[start:stop])
                if coded is None or packet.frame != coded.frame:
                    coded = decode(coded, packet)
                    yield coded
            except ValueError as error:
                yield Gap(start, stop, str(error))
    if at < len(data):
        yield Gap(at, len(data), "the bytes are damaged or cut off")


def _intact(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (kind, start, stop) of the preamble, as a part of the header, and of every packet whose CRC is right."""
    at = PREAMBLE.size
    if data[:at] == PREAMBLE.pack(MAGIC, VERSION):
        yield PacketKind.HEADER, 0, at
    if (stop := _end(data, at)) is not None:
        yield data[at], at, stop
        at = stop
    while (found := _KIND.search(data, at)) is not None:
        start = found.start()
        stop = _end(data, start)
        if stop is not None:
            yield data[start], start, stop
        at = stop or start + 1


def _end(data: bytes, start: int) -> int | None:
    """Return where the packet ends that begins at `start`, None if none does."""
    if start + PAYLOAD > len(data):
        return None
    stop = start + PAYLOAD + HEAD.unpack_from(data, start)[2]
    if stop > len(data):
        return None
    try:
        open_packet(data[start:stop])
    except ValueError:
        return None
    return stop

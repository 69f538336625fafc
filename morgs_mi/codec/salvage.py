"""What can still be played of a damaged stream: all packets are looked for by their CRC, wherever they begin.

Neither lengths nor the index are trusted, so whatever happened to the rest, an intact packet is found. A frame plays if
its packet is intact and its parent plays, or from a keyframe on.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morgs_mi.codec.container import (
    HEAD,
    MAGIC,
    PAYLOAD,
    PREAMBLE,
    VERSION,
    Packet,
    PacketKind,
    StreamWriter,
    decode_packet,
    open_packet,
)
from morgs_mi.codec.packets import CodedFrame, decode
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.files import whole

__all__ = ["DamagedRange", "salvage", "write_salvaged"]

# A packet begins with its kind, uint32. The header is not looked for: it has its place, and holes are full of zeros.
_KIND = re.compile(rb"[\1-\3]\0\0\0")


@dataclass(frozen=True)
class DamagedRange:
    """Bytes of a stream that give no frame.

    Attributes:
        start: the first of them.
        stop: the first that is none of them.
        problem: what is wrong with them.
    """

    start: int
    stop: int
    problem: str


def salvage(path: str | Path) -> Iterator[CodedFrame | DamagedRange]:
    """Yield what a stream file still says, in its order: the states of frames, and what is damaged or lost.

    A file that is cut off behind a whole packet is shorter and no more: `StreamReader.closed` tells. Cameras are not
    asked for, so frames may be played from under a header that is broken.

    Raises:
        FileNotFoundError: there is no such file.
    """
    last = None
    for found in _playable(Path(path)):
        if isinstance(found, DamagedRange):
            yield found
        elif found[1].frame != last:
            last = found[1].frame
            yield found[1]


def write_salvaged(stream: StreamReader, output: str | Path) -> tuple[list[int], list[DamagedRange]]:
    """Write what a damaged stream still says as a new one, which appears whole or not at all.

    Its packets are those of the damaged one that play, as they are; behind a gap it goes on with a keyframe, whose
    frame tells no displacements. An undamaged stream becomes a copy.

    Args:
        stream: the file; without its header nobody knows the cameras.
        output: the file to write; an existing one is replaced, but for that of `stream`.

    Returns:
        The frames that play, and what is damaged or lost.

    Raises:
        OSError: the new one cannot be written.
        ValueError: no frame plays, or `output` is the file of `stream`.
    """
    if Path(output).resolve() == stream.path.resolve():
        raise ValueError(f"{output}: expected a new file, got the damaged stream itself; give another name.")
    frames, gaps = [], []
    with (
        whole(output, "write_salvaged()") as partial,
        StreamWriter(partial, stream.cameras, stream.fps, stream.metadata) as writer,
    ):
        for found in _playable(stream.path):
            if isinstance(found, DamagedRange):
                gaps.append(found)
            else:
                writer.write(found[0])
                frames.append(found[1].frame)
        if not frames:
            raise ValueError(f"{stream.path}: expected at least one frame that plays, got none; nothing was written.")
    return list(dict.fromkeys(frames)), gaps


def _playable(path: Path) -> Iterator[tuple[Packet, CodedFrame] | DamagedRange]:
    """Yield packets with the states that they lead to or, once more, restate, and what gives neither."""
    data = path.read_bytes()  # a map of the file would end the process if somebody cut it off meanwhile
    if not data:
        yield DamagedRange(0, 0, "the file is empty")
    coded, at = None, 0
    for kind, start, stop in _intact(data):
        if start > at:
            yield DamagedRange(at, start, "the bytes are damaged")
        at = stop
        if kind in (PacketKind.KEYFRAME, PacketKind.RESIDUAL):
            try:
                packet = decode_packet(data[start:stop])
                if coded is None or packet.frame != coded.frame:
                    coded = decode(coded, packet)
                elif not np.array_equal(decode(None, packet).digest, coded.digest):
                    raise ValueError(f"it restates another state than that of frame {coded.frame}")
                yield packet, coded
            except ValueError as error:
                yield DamagedRange(start, stop, str(error))
    if at < len(data):
        yield DamagedRange(at, len(data), "the bytes are damaged or cut off")


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

"""Recovery of the playable frames of a damaged stream: packets are found by their CRC, wherever they begin.

Neither lengths nor the index are trusted, so an intact packet is found whatever happened to the rest. A frame plays if
its packet is intact and is a keyframe or has a parent that plays.
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
from morgs_mi.core.files import atomic_path

__all__ = ["DamagedRange", "salvage", "write_salvaged"]

# A packet begins with its kind, uint32. Kind 0, the header, is not searched for: its place is fixed, and erased ranges
# consist of zeros.
_KIND = re.compile(rb"[\1-\3]\0\0\0")


@dataclass(frozen=True)
class DamagedRange:
    """Byte range of a stream from which no frame can be decoded.

    Attributes:
        start: the first byte.
        stop: the first byte behind the range.
        problem: description of the damage.
    """

    start: int
    stop: int
    problem: str


def salvage(path: str | Path) -> Iterator[CodedFrame | DamagedRange]:
    """Yield the states of the playable frames of a stream file and its damaged ranges, in the order of the file.

    A file that is truncated behind a complete packet has no damaged range; see `StreamReader.closed`. Cameras are not
    needed, so the frames behind a broken header play as well.

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
    """Write the playable packets of a damaged stream as a new stream, atomically.

    The packets are copied unchanged. Behind a damaged range the new stream continues with a keyframe, whose frame has
    no displacements. An undamaged stream is copied.

    Args:
        stream: the damaged stream; its header, with the cameras, must be intact.
        output: the file to write; an existing one is replaced, unless it is the file of `stream`.

    Returns:
        The playable frames and the damaged ranges.

    Raises:
        OSError: the new file cannot be written.
        ValueError: no frame plays, or `output` is the file of `stream`.
    """
    if Path(output).resolve() == stream.path.resolve():
        raise ValueError(f"{output}: expected a new file, got the damaged stream itself; give another name.")
    frames, ranges = [], []
    with (
        atomic_path(output, "write_salvaged()") as partial,
        StreamWriter(partial, stream.cameras, stream.fps, stream.metadata) as writer,
    ):
        for found in _playable(stream.path):
            if isinstance(found, DamagedRange):
                ranges.append(found)
            else:
                writer.write(found[0])
                frames.append(found[1].frame)
        if not frames:
            raise ValueError(f"{stream.path}: expected at least one frame that plays, got none; nothing was written.")
    return list(dict.fromkeys(frames)), ranges


def _playable(path: Path) -> Iterator[tuple[Packet, CodedFrame] | DamagedRange]:
    """Yield each playable packet with the state after it, and the damaged ranges."""
    data = path.read_bytes()  # a memory map would end the process if the file were truncated meanwhile
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
                    raise ValueError(f"the re-emitted keyframe differs from the state of frame {coded.frame}")
                yield packet, coded
            except ValueError as error:
                yield DamagedRange(start, stop, str(error))
    if at < len(data):
        yield DamagedRange(at, len(data), "the bytes are damaged or truncated")


def _intact(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (kind, start, stop) of the preamble, with the header's kind, and of every packet with a correct CRC."""
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
    """Return the end of the intact packet that begins at `start`, None if there is none."""
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

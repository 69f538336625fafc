"""Recovery of the playable frames of a damaged stream: packets are found by their CRC, wherever they begin.

Lengths, order and index are not trusted, so an intact packet is found whatever happened to the rest. A frame plays if
it has an intact packet that is a keyframe or has a parent that plays. Of several packets of a frame, the one
with the state that a residual names as its parent plays, otherwise a residual before a keyframe.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

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
)
from morgs_mi.codec.crc import range_crcs
from morgs_mi.codec.packets import CodedFrame, decode
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.files import atomic_path

__all__ = ["DamagedRange", "salvage", "write_salvaged"]

# A packet begins with its kind, uint32. Kind 0, the header, is not searched for: its place is fixed, and erased ranges
# consist of zeros.
_KIND = re.compile(rb"[\1-\3]\0\0\0")
_HEAD_WITH_CRC = struct.Struct("<IIQI")
_SHORTEST = 16  # bytes of a payload: an index without entries; a frame has more


@dataclass(frozen=True)
class DamagedRange:
    """Byte range of a stream from which no frame can be decoded.

    Attributes:
        start: the first byte.
        stop: the first byte after the range.
        problem: description of the damage.
    """

    start: int
    stop: int
    problem: str


def salvage(path: str | Path) -> Iterator[CodedFrame | DamagedRange]:
    """Yield the damaged ranges of a stream file and the states of its playable frames, once each, by ascending frame.

    A file that is truncated after a complete packet has no damaged range; see `StreamReader.closed`. Cameras are not
    needed, so the frames after a broken header play too.

    Raises:
        FileNotFoundError: there is no such file.
    """
    last = None
    for found in _playable(Path(path)):
        if isinstance(found, DamagedRange):
            yield found
        elif found[1] is not last:
            last = found[1]
            yield last


def write_salvaged(stream: StreamReader, output: str | Path) -> tuple[list[int], list[DamagedRange]]:
    """Write the playable packets of a damaged stream as a new stream, atomically.

    The packets are copied unchanged, by ascending frame. After a damaged range the new stream continues with a
    keyframe; its frame has no displacements. An undamaged stream is copied.

    Args:
        stream: the damaged stream; its header, with the cameras, must be intact.
        output: the file to write; an existing one is replaced, unless it is the file of `stream`.

    Returns:
        The playable frames and the damaged ranges, both in ascending order.

    Raises:
        OSError: the new file cannot be written.
        ValueError: no frame plays, or `output` is the file of `stream`.
    """
    if Path(output).resolve() == stream.path.resolve():
        raise ValueError(f"{output}: expected a new file, got the damaged stream itself; give another name.")
    frames: list[int] = []
    ranges: list[DamagedRange] = []
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
    return list(dict.fromkeys(frames)), sorted(ranges, key=lambda found: found.start)


def _playable(path: Path) -> Iterator[tuple[Packet, CodedFrame] | DamagedRange]:
    """Yield the damaged ranges, and each playable packet with the state after it, by ascending frame."""
    data = path.read_bytes()  # a memory map would end the process if the file were truncated meanwhile
    found: list[_Found] = []
    for entry in _readable(data):
        if isinstance(entry, DamagedRange):
            yield entry
        else:
            found.append(entry)
    parents, coded = {entry.parent for entry in found}, None
    for _, entries in groupby(sorted(found), lambda entry: entry.frame):
        best, states = None, []
        for entry in entries:
            try:
                state = decode(coded, entry.packet(data))
            except (ValueError, MemoryError) as error:
                yield entry.damaged(str(error) or f"{entry.place}: its state does not fit into memory")
                continue
            states.append((entry, state.digest.tobytes()))
            if best is None or (best.digest.tobytes() not in parents and states[-1][1] in parents):
                best = state
        if best is not None:
            coded = best
            yield from _once(data, coded, states)


def _readable(data: bytes) -> Iterator[_Found | DamagedRange]:
    """Yield the damaged ranges and the intact packets of frames, in their order in the file."""
    if not data:
        yield DamagedRange(0, 0, "the file is empty")
    at = PREAMBLE.size if data.startswith(PREAMBLE.pack(MAGIC, VERSION)) else 0
    for number, (start, stop) in enumerate(_intact(data)):
        if start > at:
            yield DamagedRange(at, start, "the bytes are damaged")
        at = stop
        kind, frame, _ = HEAD.unpack_from(data, start)
        if kind in (PacketKind.KEYFRAME, PacketKind.RESIDUAL):
            entry = _Found(frame, -kind, number, start, stop)
            try:
                arrays = entry.packet(data).arrays
            except ValueError as error:
                yield entry.damaged(f"{entry.place}: {error}")
            else:
                yield entry._replace(parent=arrays["parent"].tobytes() if "parent" in arrays else b"")
    if at < len(data):
        yield DamagedRange(at, len(data), "the bytes are damaged or truncated")


def _once(
    data: bytes, coded: CodedFrame, states: list[tuple[_Found, bytes]]
) -> Iterator[tuple[Packet, CodedFrame] | DamagedRange]:
    """Yield the first packet of a state and its re-emitted keyframe; the other packets of the frame are damaged."""
    last = None
    for entry, digest in states:
        if digest != coded.digest.tobytes():
            yield entry.damaged(f"{entry.place}: another packet of frame {coded.frame} leads to another state")
        elif entry.kind == last or last == PacketKind.KEYFRAME:
            yield entry.damaged(f"{entry.place}: it repeats frame {coded.frame}")
        else:
            last = entry.kind
            yield entry.packet(data), coded


class _Found(NamedTuple):
    """An intact packet and the digest of its parent. In their order, frames ascend and residuals precede keyframes."""

    frame: int
    minus_kind: int
    number: int
    start: int
    stop: int
    parent: bytes = b""

    @property
    def kind(self) -> int:
        return -self.minus_kind

    @property
    def place(self) -> str:
        return f"intact packet {self.number}, frame {self.frame}"

    def packet(self, data: bytes) -> Packet:
        return decode_packet(data[self.start : self.stop], self.place)

    def damaged(self, problem: str) -> DamagedRange:
        return DamagedRange(self.start, self.stop, problem)


def _intact(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield (start, stop) of every packet with a correct CRC; of packets that overlap, the first."""
    starts, stops, heads, expected = np.fromiter(_candidates(data), np.dtype((np.int64, 4))).T
    right = range_crcs(data, starts + PAYLOAD, stops, heads.astype(np.uint32)) == expected
    at = 0
    for start, stop in zip(starts[right].tolist(), stops[right].tolist(), strict=True):
        if start >= at:
            yield start, stop
            at = stop


def _candidates(data: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Yield (start, stop, CRC of the head, CRC stored) of all that begins as a packet and ends within the data."""
    starts = (found.start() for found in _KIND.finditer(data, PREAMBLE.size))
    for start in chain((PREAMBLE.size,), starts):
        if start + PAYLOAD <= len(data):
            *_, length, crc = _HEAD_WITH_CRC.unpack_from(data, start)
            if _SHORTEST <= length <= len(data) - start - PAYLOAD:
                yield start, start + PAYLOAD + length, zlib.crc32(data[start : start + HEAD.size]), crc

"""Reader of a stream: a file, complete or still growing, or a pipe; from the start, or from near a
frame.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

from morgs_mi.codec.container import (
    ENTRY,
    HEAD,
    INDEX_MAGIC,
    MAGIC,
    PAYLOAD,
    PREAMBLE,
    TRAILER,
    VERSION,
    Packet,
    PacketKind,
    TruncatedStreamError,
    decode_packet,
    open_packet,
)
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.codec.header import header_fields
from morgs_mi.codec.packets import CodedFrame, coded_frames
from morgs_mi.core.bounded import open_regular

_CHUNK = 2**20

_Entry = tuple[int, int, int]


class StreamReader(FrameSource):
    """Reader of a stream.

    Iterating yields its packets from the first. A file may be read again, e.g. when it has grown; a
    pipe yields each packet once, as soon as it arrives.

    Args:
        source: path of the file, or a binary file object, such as a pipe or the file of a socket.
        skip_damaged: leave out damaged packets of a file, and all that follow one up to the next
            intact keyframe. A damaged length hides the packets after it, unless the file ends with
            an intact index.
        follow: whether the path may be a link.

    Attributes:
        path: the file.
        cameras: the rig.
        fps: frames per second.
        metadata: metadata that was passed to the writer.
        skipped: frames that are left out as damaged, ascending.

    Raises:
        FileNotFoundError: there is no such file.
        TruncatedStreamError: the stream ends inside a packet (while iterating: after the complete
            ones).
        ValueError: it is not a stream, is no regular file, has another version, or a packet is
            broken. The message names the file, the packet's number and byte offset, the number of
            intact packets before it and the frame of the last of them; or damage is to be skipped
            in a pipe.
    """

    def __init__(
        self, source: str | Path | BinaryIO, skip_damaged: bool = False, follow: bool = True
    ) -> None:
        self._follow = follow
        self._pipe = None if isinstance(source, str | Path) else source
        self.path = Path(
            source if isinstance(source, str | Path) else str(getattr(source, "name", "stream"))
        )
        with self._opened() as file:
            preamble = _read(file, PREAMBLE.size)
            if not MAGIC.startswith(preamble[:8]):
                raise ValueError(
                    f"{self.path}: expected a stream that starts with {MAGIC!r}, got "
                    f"{preamble[:8]!r}; check the path."
                )
            version = PREAMBLE.unpack(preamble)[1] if len(preamble) == PREAMBLE.size else VERSION
            if version != VERSION:
                raise ValueError(
                    f"{self.path}: expected format version {VERSION}, got {version}; "
                    "read it with the release that wrote it."
                )
            data = self._packet(file, 0, len(preamble))
        if data is None:
            raise TruncatedStreamError(self._sentence(0, len(preamble), "the header is missing"))
        with self._located(0, PREAMBLE.size):
            kind, _, payload = open_packet(data)
            if kind != PacketKind.HEADER:
                raise ValueError(f"the first packet must be the header, got kind {kind}")
            self.cameras, self.fps, self.metadata = header_fields(payload)
        self._first = PREAMBLE.size + len(data)
        self._playable_entries: list[_Entry] | None = None
        self.skipped: list[int] = []
        if skip_damaged:
            self._playable_entries, self.skipped = self._playable()

    def __repr__(self) -> str:
        frames = f"{self.metadata['num_frames']} frames, " if "num_frames" in self.metadata else ""
        return (
            f"{type(self).__name__}('{self.path}', {frames}{len(self.cameras)} cameras, "
            f"{self.fps:g} frames per second)"
        )

    def __iter__(self) -> Iterator[Packet]:
        return self._packets(1, self._first)

    def frame_numbers(self) -> list[int]:
        return list(dict.fromkeys(frame for _, frame, _ in self.index()))

    def states(self, near: int | None = None) -> Iterator[CodedFrame]:
        """Decode the packets and yield the state after each frame; see `FrameSource.states`.

        Near a frame, decoding starts at the last keyframe before it. Where the frame cannot be
        reached from there, because that keyframe or the index is forged, the states from the start
        of the stream follow.
        """
        has_frame = False
        if near is not None:
            packets = self.near(near)
            try:
                for coded in coded_frames(packets):
                    if coded.frame > near and not has_frame:
                        break
                    has_frame = has_frame or coded.frame == near
                    yield coded
            except ValueError:
                if has_frame:
                    raise
        if not has_frame:
            yield from coded_frames(self)

    def near(self, frame: int) -> Iterator[Packet]:
        """Yield the packets from the last keyframe before `frame` on, or from the first.

        Only the residual of a frame determines its displacements, so a keyframe of `frame` itself
        does not count.

        Raises:
            TruncatedStreamError: as `index`.
            ValueError: it is a pipe, which cannot seek, or a packet is broken.
        """
        self._check_is_file("to seek in")
        number = 1
        at = self._first
        for k, (kind, packet_frame, offset) in enumerate(self.index(), start=1):
            if kind == PacketKind.KEYFRAME and packet_frame < frame:
                number = k
                at = offset
        return self._packets(number, at)

    def closed(self) -> bool:
        """Return whether the file ends with its index; otherwise it is still being written, or was
        truncated.

        Raises:
            TruncatedStreamError: as `index`.
        """
        with open_regular(self.path, self._follow) as file:
            return self._last_index(file) is not None

    def index(self) -> list[_Entry]:
        """Return (kind, frame, offset) of every complete packet except the header, from the index
        if there is one.

        Those that are left out as damaged have no entry.

        Raises:
            TruncatedStreamError: the file is now shorter than the header that was read from it.
        """
        if self._playable_entries is not None:
            return list(self._playable_entries)
        with open_regular(self.path, self._follow) as file:
            if (entries := self._last_index(file)) is not None:
                return entries
            entries = []
            size = file.seek(0, 2)
            at = self._first
            while at + PAYLOAD <= size:
                file.seek(at)
                kind, frame, length = HEAD.unpack(file.read(HEAD.size))
                if kind not in (PacketKind.KEYFRAME, PacketKind.RESIDUAL, PacketKind.INDEX):
                    break  # such as a tail of zeros that a crash of the system leaves
                if at + PAYLOAD + length <= size and kind != PacketKind.INDEX:
                    entries.append((kind, frame, at))
                at += PAYLOAD + length
            return entries

    def _check_is_file(self, use: str) -> None:
        if self._pipe is not None:
            raise ValueError(f"{self.path}: expected a file {use}, got a pipe; save it first.")

    def _playable(self) -> tuple[list[_Entry], list[int]]:
        """Return the entries of the packets that play without the damaged ones, and the frames that
        do not play.
        """
        self._check_is_file("to skip damage in")
        entries = list[_Entry]()
        frames = [-1]
        plays = False
        with open_regular(self.path, self._follow) as file:
            for number, (kind, frame, offset) in enumerate(self.index(), start=1):
                file.seek(offset)
                try:
                    decode_packet(self._packet(file, number, offset) or b"")
                except ValueError:
                    # A damaged head may name any frame. A keyframe that repeats the state of a
                    # frame is not needed.
                    frames.append(frame if frame == frames[-1] else frames[-1] + 1)
                    plays = plays and entries[-1][1] == frames[-1]
                    continue
                frames.append(frame)
                plays = plays or kind == PacketKind.KEYFRAME
                if plays:
                    entries.append((kind, frame, offset))
        return entries, sorted({*frames[1:]} - {frame for _, frame, _ in entries})

    def _last_index(self, file: BinaryIO) -> list[_Entry] | None:
        """Return the entries of the index at the file's end, None if there is none."""
        size = file.seek(0, 2)
        if size < self._first:
            problem = (
                f"the header ended at byte {self._first}, now the file has {size} bytes: replaced "
                "or truncated"
            )
            raise TruncatedStreamError(self._sentence(0, PREAMBLE.size, problem))
        file.seek(size - TRAILER.size)
        at, magic = TRAILER.unpack(file.read(TRAILER.size))
        if magic != INDEX_MAGIC or not self._first <= at < size:
            return None
        file.seek(at)
        try:
            packet_kind, _, payload = open_packet(file.read(size - at))
            entries = list(ENTRY.iter_unpack(payload[: -TRAILER.size]))
        except (ValueError, struct.error):  # a payload that looks like an index by chance
            return None
        kinds = {kind for kind, *_ in entries}
        offsets = [self._first - 1, *(offset for *_, offset in entries), at]
        is_index = (
            packet_kind == PacketKind.INDEX
            and kinds <= {PacketKind.KEYFRAME, PacketKind.RESIDUAL}
            and all(a < b for a, b in pairwise(offsets))
        )
        return entries if is_index else None

    def check(self) -> tuple[list[_Entry], int]:
        """Check every packet and return (kind, frame, offset) of all except the header, and the end
        of the last one.

        An index at the file's end, and a packet that is truncated there, lie after that byte.

        Raises:
            ValueError: it is a pipe, or a packet is broken.
        """
        self._check_is_file("that is read twice")
        entries = []
        end = self._first
        with contextlib.suppress(TruncatedStreamError):
            for at, data in self._checked(1, self._first):
                kind, frame, _ = HEAD.unpack_from(data)
                if kind != PacketKind.INDEX:
                    entries.append((kind, frame, at))
                    end = at + len(data)
        return entries, end

    def _packets(self, number: int, at: int) -> Iterator[Packet]:
        last = None
        read = self._checked if self._playable_entries is None else self._undamaged
        for offset, data in read(number, at):
            if HEAD.unpack_from(data)[0] != PacketKind.INDEX:
                with self._located(number, offset, last):
                    packet = decode_packet(data, self._place(number, offset))
                yield packet
                number += 1
                last = packet.frame

    def _undamaged(self, number: int, at: int) -> Iterator[tuple[int, bytes]]:
        """Yield (offset, bytes) of the packets that are not left out, from byte `at` on."""
        with open_regular(self.path, self._follow) as file:
            for *_, offset in self.index():
                if offset >= at:
                    file.seek(offset)
                    data = self._packet(file, number, offset) or b""
                    with self._located(number, offset):  # it may have been replaced
                        open_packet(data)
                    yield offset, data
                    number += 1

    def _checked(self, number: int, at: int) -> Iterator[tuple[int, bytes]]:
        """Yield (offset, bytes) of every packet with a correct CRC, from packet `number` at byte
        `at` on.

        There may be an index between packets, if a stream was closed and continued; it has no
        number.
        """
        with self._opened() as file:
            if self._pipe is None:
                file.seek(at)
            last = None
            while (data := self._packet(file, number, at, last)) is not None:
                with self._located(number, at, last):
                    kind, frame, _ = open_packet(data)
                yield at, data
                at += len(data)
                if kind != PacketKind.INDEX:
                    number += 1
                    last = frame

    def _packet(
        self, file: BinaryIO, number: int, at: int, last: int | None = None
    ) -> bytes | None:
        """Return the bytes of the next packet, None at the stream's end."""
        head = _read(file, PAYLOAD)
        if not head:
            return None
        size = PAYLOAD + (HEAD.unpack_from(head)[2] if len(head) == PAYLOAD else 0)
        data = head + _read(file, size - PAYLOAD)
        if len(head) < PAYLOAD or len(data) < size:
            problem = f"at least {size} bytes expected, got {len(data)}: truncated or still written"
            raise TruncatedStreamError(self._sentence(number, at, problem, last))
        return data

    @contextlib.contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        if self._pipe is not None:
            yield self._pipe
        else:
            with open_regular(self.path, self._follow) as file:
                yield file

    @contextlib.contextmanager
    def _located(self, number: int, at: int, last: int | None = None) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            raise ValueError(self._sentence(number, at, str(error), last)) from None

    def _sentence(self, number: int, at: int, problem: str, last: int | None = None) -> str:
        """Return the message of a problem; `last` is the frame of the packet before it."""
        frames = "" if last is None else f", up to frame {last}"
        return (
            f"{self._place(number, at)}: {problem}; {number} packets before it are intact{frames}."
        )

    def _place(self, number: int, at: int) -> str:
        return f"{self.path}: packet {number} at byte {at}"


def _read(file: BinaryIO, count: int) -> bytes:
    """Return `count` bytes, or fewer at the end. Read in chunks, because a damaged length must not
    allocate memory.
    """
    chunks = []
    while count > 0 and (chunk := file.read(min(count, _CHUNK))):
        chunks.append(chunk)
        count -= len(chunk)
    return b"".join(chunks)

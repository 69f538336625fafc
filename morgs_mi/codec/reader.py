"""Reader of a stream: a file, complete or still growing, or a pipe; from the start, or from near a
frame.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
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
    Entry,
    Packet,
    PacketKind,
    TruncatedStreamError,
    decode_packet,
    header_fields,
    open_packet,
)
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.codec.packets import CodedFrame, coded_frames
from morgs_mi.platform.bounded import open_regular
from morgs_mi.platform.checks import quantity

_READ_SIZE = 2**20


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
        is_path = isinstance(source, str | Path)
        self._pipe = None if is_path else source
        self.path = Path(source if is_path else str(getattr(source, "name", "stream")))
        with self._opened() as file:
            preamble = _read(file, PREAMBLE.size)
            if not PREAMBLE.pack(MAGIC, VERSION).startswith(preamble):
                raise ValueError(
                    f"{self.path}: expected a stream that starts with {MAGIC!r} and version "
                    f"{VERSION}, got {preamble!r}; check the path, or read it with the release "
                    "that wrote it."
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
        self._playable_entries: list[Entry] | None = None
        self.skipped: list[int] = []
        if skip_damaged:
            self._playable_entries, self.skipped = self._playable()

    def __repr__(self) -> str:
        parts = [quantity(len(self.cameras), "camera"), f"{self.fps:g} frames per second"]
        if "num_frames" in self.metadata:
            parts.insert(0, quantity(self.metadata["num_frames"], "frame"))
        return f"{type(self).__name__}('{self.path}', {', '.join(parts)})"

    def __iter__(self) -> Iterator[Packet]:
        return self._packets(1, self._first)

    def frame_numbers(self) -> list[int]:
        return list(dict.fromkeys(frame for _, frame, _ in self.index()))

    def states(self, near: int | None = None) -> Iterator[CodedFrame]:
        """Decode the packets and yield the state after each frame; see `FrameSource.states`.

        Near a frame, decoding starts at the last keyframe before it.
        """
        return coded_frames(self if near is None else self.near(near))

    def near(self, frame: int) -> Iterator[Packet]:
        """Yield the packets from the last keyframe before `frame` on, or from the first.

        Only the residual of a frame determines its displacements, so a keyframe of `frame` itself
        does not count.

        Raises:
            TruncatedStreamError: as `index`.
            ValueError: it is a pipe, which cannot seek, or a packet is broken.
        """
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
        with self._file() as file:
            return self._last_index(file) is not None

    def index(self) -> list[Entry]:
        """Return (kind, frame, offset) of every complete packet except the header, from the index
        if there is one.

        Those that are left out as damaged have no entry.

        Raises:
            TruncatedStreamError: the file is now shorter than the header that was read from it.
            ValueError: it is a pipe.
        """
        if self._playable_entries is not None:
            return list(self._playable_entries)
        with self._file() as file:
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

    def _playable(self) -> tuple[list[Entry], list[int]]:
        """Return the entries of the packets that play without the damaged ones, and the frames that
        do not play.
        """
        entries = list[Entry]()
        frames = [-1]
        plays = False
        with self._file() as file:
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

    def _last_index(self, file: BinaryIO) -> list[Entry] | None:
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
        offsets = [self._first - 1, *(offset for *_, offset in entries), at]
        is_index = (
            packet_kind == PacketKind.INDEX
            and all(kind in (PacketKind.KEYFRAME, PacketKind.RESIDUAL) for kind, *_ in entries)
            and offsets == sorted(set(offsets))
        )
        return entries if is_index else None

    def check(self) -> tuple[list[Entry], int]:
        """Check every packet and return (kind, frame, offset) of all except the header, and the end
        of the last one.

        An index at the file's end, and a packet that is truncated there, lie after that byte.

        Raises:
            ValueError: a packet is broken.
        """
        entries = []
        end = self._first
        with contextlib.suppress(TruncatedStreamError):
            for _, at, data in self._checked(1, self._first):
                kind, frame, _ = HEAD.unpack_from(data)
                entries.append((kind, frame, at))
                end = at + len(data)
        return entries, end

    def _packets(self, number: int, at: int) -> Iterator[Packet]:
        for packet_number, offset, data in self._checked(number, at):
            with self._located(packet_number, offset):
                packet = decode_packet(data, self._place(packet_number, offset))
            yield packet

    def _checked(self, number: int, at: int) -> Iterator[tuple[int, int, bytes]]:
        """Yield (number, offset, bytes) of every packet with a correct CRC that is not left out,
        from packet `number` at byte `at` on.

        There may be an index between packets, if a stream was closed and continued; it is skipped
        and has no number.
        """
        with self._opened() as file:
            last = None
            entries = self._playable_entries
            offsets = iter([offset for *_, offset in entries or () if offset >= at])
            while True:
                if entries is not None:
                    at = next(offsets, file.seek(0, 2))
                if self._pipe is None:
                    file.seek(at)
                if (data := self._packet(file, number, at, last)) is None:
                    return
                with self._located(number, at, last):
                    kind, frame, _ = open_packet(data)
                if kind != PacketKind.INDEX:
                    yield number, at, data
                    number += 1
                    last = frame
                at += len(data)

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

    def _file(self) -> BinaryIO:
        """Open the file.

        Raises:
            ValueError: it is a pipe, which cannot seek.
        """
        if self._pipe is not None:
            raise ValueError(f"{self.path}: expected a file, got a pipe; save it first.")
        return open_regular(self.path, self._follow)

    def _opened(self) -> contextlib.AbstractContextManager[BinaryIO]:
        return self._file() if self._pipe is None else contextlib.nullcontext(self._pipe)

    @contextlib.contextmanager
    def _located(self, number: int, at: int, last: int | None = None) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            raise ValueError(self._sentence(number, at, str(error), last)) from None

    def _sentence(self, number: int, at: int, problem: str, last: int | None = None) -> str:
        """Return the message of a problem; `last` is the frame of the packet before it."""
        frames = "" if last is None else f", up to frame {last}"
        packets = quantity(number, "packet")
        return f"{self._place(number, at)}: {problem}; {packets} before it can be read{frames}."

    def _place(self, number: int, at: int) -> str:
        return f"{self.path}: packet {number} at byte {at}"


def _read(file: BinaryIO, count: int) -> bytes:
    """Return `count` bytes, or fewer at the end. Read part by part, because a damaged length must
    not allocate memory.
    """
    parts = []
    while count > 0 and (part := file.read(min(count, _READ_SIZE))):
        parts.append(part)
        count -= len(part)
    return b"".join(parts)

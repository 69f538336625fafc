"""Damaged streams: all damage is reported, every undamaged frame plays, and no damaged number is trusted."""

from __future__ import annotations

import resource
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from morgs_mi.codec.config import CodecConfig
from morgs_mi.codec.container import PAYLOAD, StreamWriter
from morgs_mi.codec.packets import (
    CodedFrame,
    coded_frames,
    decode,
    keyframe_packet,
    reemitted_keyframe,
    residual_packet,
    seek,
)
from morgs_mi.codec.reader import StreamReader
from morgs_mi.codec.salvage import DamagedRange, salvage, write_salvaged
from morgs_mi.core.gaussians import Gaussians
from tests.scenes.coded_clip import CAMERAS, cloud, jittered

FRAMES, EVERY = 8, 3
# More than a trial takes with everything that is cached, and far less than a damaged length or count may request.
MEMORY_BYTES = 64 * 2**20
# A thread of a library that starts meanwhile reserves 64 MiB for its heap and 8 MiB for its stack (glibc, measured).
THREAD_BYTES = 72 * 2**20


class Piece(NamedTuple):
    """Byte range of the file: the preamble (kind -1) or a packet."""

    kind: int
    frame: int
    start: int
    stop: int


class Clip(NamedTuple):
    data: bytes
    pieces: list[Piece]
    states: dict[int, CodedFrame]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """A stream of a few Gaussians that are born and die, with re-emitted keyframes."""
    path, rng = tmp_path_factory.mktemp("clip") / "s", np.random.default_rng(0)
    config = CodecConfig(quality=0.3, offset=True)
    with StreamWriter(path, CAMERAS[:1], 25, {"num_frames": FRAMES}) as writer:
        packet = keyframe_packet(cloud(6, 0), 0, CAMERAS, config)
        states = [decode(None, packet)]
        writer.write(packet)
        for frame in range(1, FRAMES):
            before = states[-1]
            alive = np.arange(1, len(before))
            now = Gaussians.concatenate([jittered(before.gaussians, rng).select(alive), cloud(1, 0, seed=frame)])
            now = replace(now, offset=rng.normal(0, 0.05, (len(now), 3)))
            packet = residual_packet(before, now, np.r_[alive, -1], CAMERAS, config)
            states.append(decode(before, packet))
            writer.write(packet)
            if frame % EVERY == 0:
                writer.write(reemitted_keyframe(states[-1]))
    data = path.read_bytes()
    pieces, at = [Piece(-1, 0, 0, 12)], 12
    while at < len(data):
        kind, frame, length = struct.unpack_from("<IIQ", data, at)
        pieces.append(Piece(kind, frame, at, at + PAYLOAD + length))
        at = pieces[-1].stop
    return Clip(data, pieces, {state.frame: state for state in states})


@contextmanager
def little_memory() -> Iterator[None]:
    """Limit the address space of this process to `MEMORY_BYTES` more than now, and room for one new thread."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY_BYTES + THREAD_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the data truncated, with one or several flipped bits, or with an overwritten range."""
    spoilt, kind = bytearray(data), rng.integers(4)
    if kind == 0:
        return data[: rng.integers(len(data))]
    if kind == 3:
        start, length = rng.integers(len(data)), rng.integers(1, 200)
        size = len(spoilt[start : start + length])
        spoilt[start : start + length] = bytes(size) if rng.random() < 0.5 else rng.bytes(size)
    for at in rng.choice(8 * len(data), 1 if kind == 1 else rng.integers(2, 9) if kind == 2 else 0, replace=False):
        spoilt[at // 8] ^= 1 << at % 8
    return bytes(spoilt)


def playable(clip: Clip, intact: list[bool]) -> list[int]:
    """Return the playable frames: those whose packets are intact back to a keyframe."""
    frames: list[int] = []
    for piece, ok in zip(clip.pieces, intact, strict=True):
        known = bool(frames) and piece.frame in (frames[-1], frames[-1] + 1)
        if ok and piece.frame not in frames and (piece.kind == 1 or (piece.kind == 2 and known)):
            frames.append(piece.frame)
    return frames


def check(clip: Clip, data: bytes, path: Path) -> None:
    path.write_bytes(data)
    intact = [data[piece.start : piece.stop] == clip.data[piece.start : piece.stop] for piece in clip.pieces]
    intact = [same and piece.stop <= len(data) for same, piece in zip(intact, clip.pieces, strict=True)]
    first = intact.index(False)  # the first damaged piece
    # Playing stops there with an error, unless the file just ends; then it is not closed.
    played: list[CodedFrame] = []
    if clip.pieces[first].start == len(data) and first > 1:
        reader = StreamReader(path)
        played.extend(coded_frames(reader))
        assert not reader.closed()
    else:
        with pytest.raises(ValueError, match=str(path)) as error:
            played.extend(coded_frames(StreamReader(path)))
        if first:  # the message names the place, except for the preamble
            number, at = max(first - 1, 0), clip.pieces[first].start
            assert f"packet {number} at byte {at}: " in str(error.value)
    assert [state.frame for state in played] == sorted({p.frame for p in clip.pieces[2:first] if p.kind < 3})
    # Intact packets behind it play as well, and damaged ones are reported.
    found = list(salvage(path))
    states = [entry for entry in found if isinstance(entry, CodedFrame)]
    assert [state.frame for state in states] == playable(clip, intact)
    for state in [*played, *states]:
        assert np.array_equal(state.digest, clip.states[state.frame].digest)
    ranges = [entry for entry in found if isinstance(entry, DamagedRange)]
    for piece, ok in zip(clip.pieces, intact, strict=True):
        end = min(piece.stop, len(data))
        assert ok or piece.start >= end or any(r.start <= piece.start and end <= r.stop for r in ranges), piece
    for damage in ranges:
        assert 0 <= damage.start < damage.stop <= len(data) or not data
    # All of it can be written as an intact stream, if there is a playable frame.
    if intact[0] and intact[1] and states:
        again = rewritten(path)
        assert again == ([state.frame for state in states], ranges, [state.digest.tobytes() for state in states])
    # A reader that trusts an intact index also reaches the frames behind the damage.
    if intact[0] and intact[1] and intact[-1]:
        for piece in clip.pieces[first + 1 : -1]:
            behind = [p for p in clip.pieces[first:] if p.start >= piece.start and p.frame <= piece.frame + 1]
            if piece.kind == 1 and piece.frame + 1 < FRAMES and all(intact[clip.pieces.index(p)] for p in behind):
                state = seek(StreamReader(path), piece.frame + 1)
                assert np.array_equal(state.digest, clip.states[piece.frame + 1].digest)


def rewritten(path: Path) -> tuple[list[int], list[DamagedRange], list[bytes]]:
    """Return the results of `write_salvaged` and the digests of the states in the stream that it wrote."""
    new = path.with_name("new")
    frames, ranges = write_salvaged(StreamReader(path), new)
    reader = StreamReader(new)
    assert reader.closed()
    states = list(coded_frames(reader))
    assert [state.frame for state in states] == frames
    assert np.array_equal(seek(reader, frames[-1]).digest, states[-1].digest)
    return frames, ranges, [state.digest.tobytes() for state in states]


def check_damage(clip: Clip, path: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    for length in (*range(40), len(clip.data) - 1):
        check(clip, clip.data[:length], path)
    with little_memory():
        for trial in range(count):
            data = damaged(clip.data, rng)
            if data != clip.data:
                try:
                    check(clip, data, path)
                except BaseException as error:
                    raise AssertionError(f"damage {trial} of seed 0") from error


def test_salvage__reports_all_damage_and_plays_the_rest(clip: Clip, tmp_path: Path) -> None:
    check_damage(clip, tmp_path / "s", 40)


@pytest.mark.slow
def test_salvage__reports_all_damage_of_ten_thousand_files(clip: Clip, tmp_path: Path) -> None:
    check_damage(clip, tmp_path / "s", 10_000)


def check_forgery(clip: Clip, path: Path, count: int) -> None:
    """Change bytes inside packets and adapt their CRC."""
    rng = np.random.default_rng(1)
    with little_memory():
        for _ in range(count):
            spoilt, piece = bytearray(clip.data), clip.pieces[rng.integers(1, len(clip.pieces))]
            # Half of them among the numbers that determine the sizes of arrays.
            stop = piece.stop if rng.random() < 0.5 else min(piece.start + PAYLOAD + 120, piece.stop)
            for at in rng.integers(piece.start + PAYLOAD, stop, rng.integers(1, 4)):
                spoilt[at] = rng.integers(256)
            head, payload = spoilt[piece.start : piece.start + 16], spoilt[piece.start + PAYLOAD : piece.stop]
            spoilt[piece.start + 16 : piece.start + PAYLOAD] = struct.pack("<I", zlib.crc32(head + payload))
            path.write_bytes(spoilt)
            found = list(salvage(path))
            if piece.kind:
                assert rewritten(path)[0] == [entry.frame for entry in found if isinstance(entry, CodedFrame)]
            try:
                played = list(coded_frames(StreamReader(path)))
            except ValueError:
                played = []
            # A forged packet may result in another state of its frame, which the next residual refuses.
            others = [s.frame for s in found if isinstance(s, CodedFrame) and differs(s, clip)]
            others += [s.frame for s in played if differs(s, clip)]
            assert set(others) <= {piece.frame}, (piece, others)


def differs(state: CodedFrame, clip: Clip) -> bool:
    return not np.array_equal(state.digest, clip.states[state.frame].digest)


def test_salvage__a_forged_packet_affects_its_own_frame_at_most(clip: Clip, tmp_path: Path) -> None:
    check_forgery(clip, tmp_path / "s", 40)


@pytest.mark.slow
def test_salvage__five_thousand_forged_packets_affect_their_own_frame_at_most(clip: Clip, tmp_path: Path) -> None:
    check_forgery(clip, tmp_path / "s", 5_000)


def test_write_salvaged__copies_an_intact_stream(clip: Clip, tmp_path: Path) -> None:
    (tmp_path / "s").write_bytes(clip.data)
    assert write_salvaged(StreamReader(tmp_path / "s"), tmp_path / "new") == (list(range(FRAMES)), [])
    assert (tmp_path / "new").read_bytes() == clip.data


def test_write_salvaged__raises_and_writes_nothing_if_no_frame_plays(clip: Clip, tmp_path: Path) -> None:
    (tmp_path / "s").write_bytes(clip.data[: clip.pieces[2].start + 50])
    reader = StreamReader(tmp_path / "s")
    with pytest.raises(ValueError, match="expected at least one frame that plays, got none"):
        write_salvaged(reader, tmp_path / "new")
    with pytest.raises(ValueError, match="expected a new file, got the damaged stream itself"):
        write_salvaged(reader, tmp_path / "." / "s")
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


def test_salvage__reports_an_empty_file_and_a_file_of_zeros(tmp_path: Path) -> None:
    (tmp_path / "s").write_bytes(b"")
    assert [entry.problem for entry in salvage(tmp_path / "s") if isinstance(entry, DamagedRange)] == [
        "the file is empty"
    ]
    (tmp_path / "s").write_bytes(bytes(10_000))
    assert list(salvage(tmp_path / "s")) == [DamagedRange(0, 10_000, "the bytes are damaged or truncated")]

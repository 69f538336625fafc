"""Damaged streams: every damage is named, every undamaged frame plays, and no number of theirs is believed."""

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
from tests.codec.test_packets import CAMERAS, cloud, jittered

FRAMES, EVERY = 8, 3
# More than a trial takes with all that is cached, and far less than a damaged length or count may ask for.
ROOM = 64 * 2**20


class ActiveSet(NamedTuple):
    """A piece of the file: the preamble (kind -1) or a packet."""

    kind: int
    frame: int
    start: int
    stop: int


class Clip(NamedTuple):
    data: bytes
    parts: list[ActiveSet]
    states: dict[int, CodedFrame]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """A stream of a handful of Gaussians that are born and die, with keyframes to start from."""
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
    parts, at = [ActiveSet(-1, 0, 0, 12)], 12
    while at < len(data):
        kind, frame, length = struct.unpack_from("<IIQ", data, at)
        parts.append(ActiveSet(kind, frame, at, at + PAYLOAD + length))
        at = parts[-1].stop
    return Clip(data, parts, {state.frame: state for state in states})


@contextmanager
def little_memory() -> Iterator[None]:
    """Let this process have `ROOM` more of address space and no more."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ROOM, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Truncate, flip one bit or some, or overwrite a stretch."""
    spoilt, kind = bytearray(data), rng.integers(4)
    if kind == 0:
        return data[: rng.integers(len(data))]
    if kind == 3:
        start, length = rng.integers(len(data)), rng.integers(1, 200)
        stretch = spoilt[start : start + length]
        spoilt[start : start + length] = bytes(len(stretch)) if rng.random() < 0.5 else rng.bytes(len(stretch))
    for at in rng.choice(8 * len(data), 1 if kind == 1 else rng.integers(2, 9) if kind == 2 else 0, replace=False):
        spoilt[at // 8] ^= 1 << at % 8
    return bytes(spoilt)


def playable(clip: Clip, intact: list[bool]) -> list[int]:
    """Return the frames that play: those whose packets are intact back to a keyframe."""
    frames: list[int] = []
    for part, whole in zip(clip.parts, intact, strict=True):
        known = bool(frames) and part.frame in (frames[-1], frames[-1] + 1)
        if whole and part.frame not in frames and (part.kind == 1 or (part.kind == 2 and known)):
            frames.append(part.frame)
    return frames


def check(clip: Clip, data: bytes, path: Path) -> None:
    path.write_bytes(data)
    intact = [data[part.start : part.stop] == clip.data[part.start : part.stop] for part in clip.parts]
    intact = [same and part.stop <= len(data) for same, part in zip(intact, clip.parts, strict=True)]
    first = intact.index(False)  # what is damaged first
    # Playing stops there with a sentence, unless the file simply ends; then it does not claim to be closed.
    played: list[CodedFrame] = []
    if clip.parts[first].start == len(data) and first > 1:
        reader = StreamReader(path)
        played.extend(coded_frames(reader))
        assert not reader.closed()
    else:
        with pytest.raises(ValueError, match=str(path)) as error:
            played.extend(coded_frames(StreamReader(path)))
        if first:  # but for the magic, the place is named
            number, at = max(first - 1, 0), clip.parts[first].start
            assert f"packet {number} at byte {at}: " in str(error.value)
    assert [state.frame for state in played] == sorted({part.frame for part in clip.parts[2:first] if part.kind < 3})
    # What is intact behind it plays as well, and what is not is named.
    found = list(salvage(path))
    states = [one for one in found if isinstance(one, CodedFrame)]
    assert [state.frame for state in states] == playable(clip, intact)
    for state in [*played, *states]:
        assert np.array_equal(state.digest, clip.states[state.frame].digest)
    gaps = [one for one in found if isinstance(one, DamagedRange)]
    for part, whole in zip(clip.parts, intact, strict=True):
        end = min(part.stop, len(data))
        assert whole or part.start >= end or any(g.start <= part.start and end <= g.stop for g in gaps), part
    for gap in gaps:
        assert 0 <= gap.start < gap.stop <= len(data) or not data
    # All of that can be had as a stream that is whole, if there is anything.
    if intact[0] and intact[1] and states:
        again = rewritten(path)
        assert again == ([state.frame for state in states], gaps, [state.digest.tobytes() for state in states])
    # A reader that trusts an intact index gets to the frames behind the damage, too.
    if intact[0] and intact[1] and intact[-1]:
        for part in clip.parts[first + 1 : -1]:
            behind = [p for p in clip.parts[first:] if p.start >= part.start and p.frame <= part.frame + 1]
            if part.kind == 1 and part.frame + 1 < FRAMES and all(intact[clip.parts.index(p)] for p in behind):
                state = seek(StreamReader(path), part.frame + 1)
                assert np.array_equal(state.digest, clip.states[part.frame + 1].digest)


def rewritten(path: Path) -> tuple[list[int], list[DamagedRange], list[bytes]]:
    """Return what `write_salvaged` says, and the digests of the states in the stream that it wrote."""
    new = path.with_name("new")
    frames, gaps = write_salvaged(StreamReader(path), new)
    reader = StreamReader(new)
    assert reader.closed()
    states = list(coded_frames(reader))
    assert [state.frame for state in states] == frames
    assert np.array_equal(seek(reader, frames[-1]).digest, states[-1].digest)
    return frames, gaps, [state.digest.tobytes() for state in states]


def damage(clip: Clip, path: Path, count: int) -> None:
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


def test_every_damage_is_named_and_all_else_plays(clip: Clip, tmp_path: Path) -> None:
    damage(clip, tmp_path / "s", 80)


@pytest.mark.slow
def test_every_damage_of_ten_thousand_is_named_and_all_else_plays(clip: Clip, tmp_path: Path) -> None:
    damage(clip, tmp_path / "s", 10_000)


def lie(clip: Clip, path: Path, count: int) -> None:
    """Change bytes within packets and make their CRC fit."""
    rng = np.random.default_rng(1)
    with little_memory():
        for _ in range(count):
            spoilt, part = bytearray(clip.data), clip.parts[rng.integers(1, len(clip.parts))]
            # Half of them where the numbers stand that say how much there is.
            stop = part.stop if rng.random() < 0.5 else min(part.start + PAYLOAD + 120, part.stop)
            for at in rng.integers(part.start + PAYLOAD, stop, rng.integers(1, 4)):
                spoilt[at] = rng.integers(256)
            head, payload = spoilt[part.start : part.start + 16], spoilt[part.start + PAYLOAD : part.stop]
            spoilt[part.start + 16 : part.start + PAYLOAD] = struct.pack("<I", zlib.crc32(head + payload))
            path.write_bytes(spoilt)
            found = list(salvage(path))
            if part.kind:
                assert rewritten(path)[0] == [one.frame for one in found if isinstance(one, CodedFrame)]
            try:
                played = list(coded_frames(StreamReader(path)))
            except ValueError:
                played = []
            # A lie may give another state of that frame; what was to follow refuses it.
            others = [s.frame for s in found if isinstance(s, CodedFrame) and differs(s, clip)]
            others += [s.frame for s in played if differs(s, clip)]
            assert set(others) <= {part.frame}, (part, others)


def differs(state: CodedFrame, clip: Clip) -> bool:
    return not np.array_equal(state.digest, clip.states[state.frame].digest)


def test_packets_that_lie_deceive_about_their_own_frame_at_most(clip: Clip, tmp_path: Path) -> None:
    lie(clip, tmp_path / "s", 80)


@pytest.mark.slow
def test_five_thousand_lies_deceive_about_their_own_frame_at_most(clip: Clip, tmp_path: Path) -> None:
    lie(clip, tmp_path / "s", 5_000)


def test_a_stream_that_is_whole_is_salvaged_to_the_same_bytes(clip: Clip, tmp_path: Path) -> None:
    (tmp_path / "s").write_bytes(clip.data)
    assert write_salvaged(StreamReader(tmp_path / "s"), tmp_path / "new") == (list(range(FRAMES)), [])
    assert (tmp_path / "new").read_bytes() == clip.data


def test_what_cannot_be_salvaged_is_said_and_nothing_is_written(clip: Clip, tmp_path: Path) -> None:
    (tmp_path / "s").write_bytes(clip.data[: clip.parts[2].start + 50])
    reader = StreamReader(tmp_path / "s")
    with pytest.raises(ValueError, match="expected at least one frame that plays, got none"):
        write_salvaged(reader, tmp_path / "new")
    with pytest.raises(ValueError, match="expected a new file, got the damaged stream itself"):
        write_salvaged(reader, tmp_path / "." / "s")
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


def test_an_empty_file_and_one_of_something_else_hold_nothing(tmp_path: Path) -> None:
    (tmp_path / "s").write_bytes(b"")
    assert [gap.problem for gap in salvage(tmp_path / "s") if isinstance(gap, DamagedRange)] == ["the file is empty"]
    (tmp_path / "s").write_bytes(bytes(10_000))
    assert list(salvage(tmp_path / "s")) == [DamagedRange(0, 10_000, "the bytes are damaged or cut off")]

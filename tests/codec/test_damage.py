"""Damaged and forged streams: all damage is reported, every undamaged frame plays, and no damaged number is trusted."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.codec.container import Packet, PacketKind
from morgs_mi.codec.packets import CodedFrame, coded_frames, decode, keyframe_packet, reemitted_keyframe, seek
from morgs_mi.codec.quantisation import Grid
from morgs_mi.codec.reader import StreamReader
from morgs_mi.codec.salvage import DamagedRange, salvage, write_salvaged
from tests.codec.forge import forged_streams
from tests.codec.fuzz import FUZZERS, check_intact_frames, differs
from tests.scenes.coded_clip import CAMERAS, cloud
from tests.scenes.short_clip import FRAMES, Clip, short_clip

FUZZ_SECONDS = float(os.environ.get("MORGS_FUZZ_SECONDS", "600"))
"""Time that `make test-slow` spends on each fuzzer."""


@pytest.fixture(scope="module")
def clip() -> Clip:
    return short_clip()


def fuzz(seconds: float, *names: str) -> None:
    """Run fuzzers in a process of their own and check that it ends well."""
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-m", "tests.codec.fuzz", str(seconds), *names]
    result = subprocess.run(command, capture_output=True, text=True, env=os.environ | single, check=False)
    assert result.returncode == 0, f"status {result.returncode}\n{result.stderr[-5000:]}"
    counts = json.loads(result.stdout)["fuzzers"]
    assert all(counts[name]["streams"] > 0 for name in names)


def test_readers__survive_damaged_and_forged_streams() -> None:
    fuzz(0.3, *FUZZERS)


@pytest.mark.long
@pytest.mark.parametrize("name", FUZZERS)
def test_readers__survive_minutes_of_damaged_and_forged_streams(name: str) -> None:
    fuzz(FUZZ_SECONDS, name)


def test_salvage__plays_what_a_truncated_file_has(clip: Clip, tmp_path: Path) -> None:
    for length in (*range(0, 40, 3), len(clip.data) - 1):
        (tmp_path / "s").write_bytes(clip.data[:length])
        check_intact_frames(clip, clip.data[:length], tmp_path / "s")


def rearranged(clip: Clip, *pieces: int) -> bytes:
    """Return the preamble, the header, and then packets of the clip by their place."""
    parts = (clip.pieces[k] for k in (0, 1, *pieces))
    return b"".join(clip.data[part.start : part.stop] for part in parts)


def salvaged(path: Path) -> tuple[list[CodedFrame], list[DamagedRange]]:
    found = list(salvage(path))
    return [e for e in found if isinstance(e, CodedFrame)], [e for e in found if isinstance(e, DamagedRange)]


@pytest.mark.parametrize(
    ("pieces", "problem"),
    [
        ((2, 3, 4, 5, 6, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12), "it repeats frame 1"),
        ((9, 10, 11, 12, 2, 3, 4, 5, 6, 7, 8), None),
        ((12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2), None),
        ((2, 3, 4, 5, 6, 6, 7, 8, 9, 10, 11, 12), "intact packet 6, frame 3: it repeats frame 3"),
    ],
    ids=["repeated", "swapped", "reversed", "repeated keyframe"],
)
def test_write_salvaged__restores_the_order_of_packets(
    clip: Clip, tmp_path: Path, pieces: tuple[int, ...], problem: str | None
) -> None:
    (tmp_path / "s").write_bytes(rearranged(clip, *pieces))
    frames, ranges = write_salvaged(StreamReader(tmp_path / "s"), tmp_path / "new")
    assert frames == list(range(FRAMES))
    assert (tmp_path / "new").read_bytes() == clip.data
    assert (problem is None) == (not ranges)
    assert problem is None or problem in ranges[0].problem


def test_salvage__prefers_the_packet_whose_state_is_continued(clip: Clip, tmp_path: Path) -> None:
    """A forged keyframe in front of the true one does not cost the frames that follow."""
    forged = keyframe_packet(cloud(9, 0), 3, CAMERAS).encoded
    data = rearranged(clip) + forged + rearranged(clip, *range(6, len(clip.pieces)))[clip.pieces[1].stop :]
    (tmp_path / "s").write_bytes(data)
    states, ranges = salvaged(tmp_path / "s")
    assert [state.frame for state in states] == list(range(3, FRAMES))
    assert not any(differs(state, clip) for state in states)
    assert ranges == [
        DamagedRange(
            clip.pieces[1].stop,
            clip.pieces[1].stop + len(forged),
            "intact packet 1, frame 3: another packet of frame 3 leads to another state",
        )
    ]


def test_salvage__continues_behind_a_packet_that_takes_too_much_memory(clip: Clip, tmp_path: Path) -> None:
    words = np.zeros(1000, np.uint32)
    bomb = Packet(PacketKind.KEYFRAME, 2, {"head": np.array([2**29, 3, 0, 2**29], np.uint32), "code": words}).encoded
    at = clip.pieces[4].start
    (tmp_path / "s").write_bytes(clip.data[:at] + bomb + clip.data[at:])
    states, ranges = salvaged(tmp_path / "s")
    assert [state.frame for state in states] == list(range(FRAMES))
    assert len(ranges) == 1
    assert "take at least 2248146944 words of code, got 1000" in ranges[0].problem


def test_seek__plays_from_the_start_where_a_keyframe_or_the_index_is_forged(clip: Clip, tmp_path: Path) -> None:
    for data in forged_streams(clip):
        (tmp_path / "s").write_bytes(data)
        stream = StreamReader(tmp_path / "s")
        for state in coded_frames(stream):
            assert not differs(seek(stream, state.frame), clip)


def constant(N: int, degree: int) -> CodedFrame:
    """Return N equal Gaussians, which an entropy code stores in almost no bytes."""
    C = 10 + 3 * (degree + 1) ** 2
    grid = Grid(np.zeros((N, C), np.int32), np.zeros((N, 8), np.int8), np.zeros(N, np.uint8), degree, 0)
    return CodedFrame(0, grid, np.arange(N, dtype=np.uint32), N, cloud(1))


def test_reemitted_keyframe__is_padded_to_the_words_that_its_integers_need() -> None:
    free = 2**22 // 67
    assert len(reemitted_keyframe(constant(free, 3)).arrays["code"]) == -(-free // 16)
    packet = reemitted_keyframe(constant(free + 1, 3))
    assert len(packet.arrays["code"]) == -(-(free + 1) * 67 // 16)
    short = {**packet.arrays, "code": packet.arrays["code"][:-1]}
    with pytest.raises(ValueError, match=r"62602 new of 62602 Gaussians take at least \d+ words of code, got \d+"):
        decode(None, Packet(packet.kind, 0, short))
    assert len(decode(None, packet)) == free + 1


def test_decode__refuses_a_count_before_it_allocates(tmp_path: Path) -> None:
    """A keyframe of 1 MB could request 4 million Gaussians of 67 integers."""
    code = np.zeros(2**18, np.uint32)
    packet = Packet(PacketKind.KEYFRAME, 0, {"head": np.array([2**22, 3, 0, 2**22], np.uint32), "code": code})
    tracemalloc.start()
    with pytest.raises(ValueError, match="words of code"):
        decode(None, packet)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_salvage__takes_linear_time_for_overlapping_false_packets(clip: Clip, tmp_path: Path) -> None:
    """Each of 30,000 heads claims that its packet ends near the file's end; all are refused by their CRC at once."""
    count, size = 30_000, 48
    length = count * size
    heads = (struct.pack("<IIQI", 1, 0, length - k * size, 7).ljust(size, b"\xff") for k in range(count))
    data = clip.data + b"".join(heads) + bytes(200)
    (tmp_path / "s").write_bytes(data)
    start = time.process_time()
    states, ranges = salvaged(tmp_path / "s")
    assert time.process_time() - start < 5  # one CRC for each takes 20 s
    assert [state.frame for state in states] == list(range(FRAMES))
    assert ranges == [DamagedRange(len(clip.data), len(data), "the bytes are damaged or truncated")]


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

"""Damaged and forged streams: all damage is reported, every undamaged frame plays, and no damaged
number is trusted.
"""

import io
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import CodedFrame, coded_frames, decode, reemitted_keyframe
from morgs_mi.codec.quantisation import Grid
from morgs_mi.codec.reader import StreamReader
from tests.codec.fuzz import FUZZERS, differs
from tests.scenes.coded_clip import cloud
from tests.scenes.short_clip import FRAMES, short_clip

FUZZ_SECONDS = float(os.environ.get("MORGS_FUZZ_SECONDS", "600"))
"""Time that `make test-slow` spends on each fuzzer."""


@pytest.fixture(scope="module")
def clip():
    return short_clip()


def fuzz(cases, seconds, *names):
    """Run fuzzers in a process of their own and check that it ends well."""
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-m", "tests.codec.fuzz", str(cases), str(seconds), *names]
    result = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | single, check=False
    )
    assert result.returncode == 0, f"status {result.returncode}\n{result.stderr[-5000:]}"
    counts = json.loads(result.stdout)["fuzzers"]
    assert all(counts[name]["streams"] > 0 for name in names)


def test_readers__survive_damaged_and_forged_streams():
    fuzz(50, 300, *FUZZERS)  # the same cases on any machine


@pytest.mark.long
@pytest.mark.parametrize("name", FUZZERS)
def test_readers__survive_minutes_of_damaged_and_forged_streams(name):
    fuzz(np.inf, FUZZ_SECONDS, name)


def flipped(clip, *frames, kind=2):
    """Return the clip with a flipped bit in the packets of a kind of some frames."""
    data = bytearray(clip.data)
    for piece in clip.pieces:
        if (piece.kind, piece.frame) in {(kind, frame) for frame in frames}:
            data[(piece.start + piece.stop) // 2] ^= 1
    return bytes(data)


def test_stream_reader__names_packet_byte_and_frame_of_damage(clip, tmp_path):
    (tmp_path / "s").write_bytes(flipped(clip, 2))
    place = f"s: packet 3 at byte {clip.pieces[4].start}: its CRC should be "
    with pytest.raises(
        ValueError,
        match=f"{place}.*: the bytes are damaged; 3 packets before it can be read, up to frame 1",
    ):
        list(coded_frames(StreamReader(tmp_path / "s")))


@pytest.mark.parametrize(
    ("frames", "kind", "skipped"),
    [
        ((1,), 2, [1, 2]),  # frames 3 and 6 have a keyframe beside their residual
        ((3,), 2, []),
        ((3,), 1, []),
        ((7,), 2, [7]),
        ((1, 5), 2, [1, 2, 5]),
        ((0,), 1, [0, 1, 2]),
        ((), 1, []),
    ],
)
def test_stream_reader__continues_at_the_next_intact_keyframe(
    clip, tmp_path, frames, kind, skipped
):
    (tmp_path / "s").write_bytes(flipped(clip, *frames, kind=kind))
    stream = StreamReader(tmp_path / "s", skip_damaged=True)
    assert stream.skipped == skipped
    states = list(coded_frames(stream))
    assert [state.frame for state in states] == sorted({*range(FRAMES)} - {*skipped})
    assert {frame for _, frame, _ in stream.index()} == {state.frame for state in states}
    for state in states:
        assert not differs(state, clip)
        assert not differs(stream.seek(state.frame), clip)


def test_stream_reader__skips_the_rest_behind_a_damaged_length_without_an_index(clip, tmp_path):
    damaged = clip.pieces[4]
    data = bytearray(clip.data)
    data[damaged.start + 8] ^= 1  # the lowest byte of its length
    (tmp_path / "s").write_bytes(data)
    assert StreamReader(tmp_path / "s", skip_damaged=True).skipped == [2], (
        "the index leads to the others"
    )
    (tmp_path / "s").write_bytes(data[: clip.pieces[-1].start])
    stream = StreamReader(tmp_path / "s", skip_damaged=True)
    assert [state.frame for state in coded_frames(stream)] == [0, 1]
    assert stream.skipped[0] == 2
    assert not stream.closed()


@pytest.mark.parametrize(
    "read",
    [lambda data: StreamReader(data, skip_damaged=True), lambda data: StreamReader(data).near(1)],
)
def test_stream_reader__skips_no_damage_and_does_not_seek_in_a_pipe(clip, read):
    with pytest.raises(ValueError, match="expected a file, got a pipe; save it first"):
        next(iter(read(io.BytesIO(clip.data))))


def constant(N, degree):
    """Return N equal Gaussians, which an entropy code stores in almost no bytes."""
    C = 10 + 3 * (degree + 1) ** 2
    grid = Grid(
        np.zeros((N, C), np.int32), np.zeros((N, 8), np.int8), np.zeros(N, np.uint8), degree, 0
    )
    return CodedFrame(0, np.arange(N, dtype=np.uint32), cloud(1), grid, N)


@pytest.mark.slow
def test_reemitted_keyframe__is_padded_to_the_words_that_its_integers_need():
    free = 2**22 // 67
    assert len(reemitted_keyframe(constant(free, 3)).arrays["code"]) == -(-free // 16)
    packet = reemitted_keyframe(constant(free + 1, 3))
    assert len(packet.arrays["code"]) == -(-(free + 1) * 67 // 16)
    short = {**packet.arrays, "code": packet.arrays["code"][:-1]}
    with pytest.raises(ValueError, match=r"62602 births take at least \d+ words of code, got \d+"):
        decode(None, Packet(packet.kind, 0, short))
    assert len(decode(None, packet)) == free + 1

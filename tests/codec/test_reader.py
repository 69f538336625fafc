"""Reading a stream: in order, from a frame on, from a pipe, and on any number of threads."""

import os
import socket
import subprocess
import sys
import threading

import pytest

from morgs_mi.codec.container import StreamWriter, TruncatedStreamError
from morgs_mi.codec.packets import (
    coded_frames,
)
from morgs_mi.codec.reader import StreamReader
from tests.scenes.coded_clip import CAMERAS, assert_same, encoded_clip, history, write


def test_seek__equals_playing_with_and_without_an_index(tmp_path):
    packets, states = encoded_clip(14)
    path = tmp_path / "s"
    write(path, packets, states)
    whole = path.read_bytes()
    packets_alone = whole[: -(20 + 16 + 16 * (14 + 3))]
    path.write_bytes(packets_alone + bytes(1000))  # as a crash of the system leaves it
    assert len(StreamReader(path).index()) == 14 + 3
    for data in (whole, packets_alone):
        path.write_bytes(data)
        reader = StreamReader(path)
        assert len(reader.index()) == 14 + 3
        for state in states:
            assert_same(reader.seek(state.frame), state)
        assert len(list(reader.near(9))) == 14 + 3 - 10  # starting at the keyframe of frame 8
    with pytest.raises(ValueError, match="expected a frame of the stream, got 14"):
        StreamReader(path).seek(14)


def tcp():
    with socket.create_server(("127.0.0.1", 0)) as server:
        sender = socket.create_connection(server.getsockname())
        receiver, _ = server.accept()
    with sender, receiver:  # the files keep them open
        return receiver.makefile("rb"), sender.makefile("wb", buffering=0)


def test_stream_reader__receives_frames_while_they_are_written():
    packets, states = encoded_clip(5)
    source, sink = tcp()
    got = []
    arrived = threading.Semaphore(0)

    def receive():
        with source:
            for state in coded_frames(StreamReader(source)):
                got.append(state)
                arrived.release()

    receiver = threading.Thread(target=receive)
    receiver.start()
    with sink:
        with StreamWriter(sink, CAMERAS, 25) as writer:
            for packet in packets:
                writer.write(packet)
                assert arrived.acquire(timeout=20), "a frame arrives as soon as it was written"
        assert not sink.closed
    receiver.join(20)
    for received_state, state in zip(got, states, strict=True):
        assert_same(received_state, state)


def test_stream_reader__reports_a_lost_connection_after_complete_frames():
    packets, states = encoded_clip(3)
    source, sink = tcp()
    with sink:
        writer = StreamWriter(sink, CAMERAS, 25)
        writer.write(packets[0])
        sink.write(packets[1].encoded[:-1])
    got = []
    with (
        source,
        pytest.raises(
            TruncatedStreamError,
            match=r"packet 2 at byte .*: truncated or still written; 2 packets",
        ),
    ):
        got.extend(coded_frames(StreamReader(source)))
    assert_same(got[0], states[0])
    assert len(got) == 1


@pytest.mark.slow
@pytest.mark.parametrize("frames", [60, pytest.param(300, marks=pytest.mark.long)])
def test_coded_frames__equal_the_encoders_states_on_one_thread_and_on_many(tmp_path, frames):
    packets, states = encoded_clip(frames, degree=0)
    write(tmp_path / "s", packets, states, every=50)
    program = f"""
import drjit as dr
import mitsuba as mi; mi.set_variant("llvm_ad_rgb")
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from tests.scenes.coded_clip import history
dr.set_thread_count(1)
print(history(coded_frames(StreamReader({str(tmp_path / "s")!r}))))
"""
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-c", program]
    result = subprocess.run(
        command, capture_output=True, text=True, check=True, env=os.environ | single
    )
    expected = history(states)
    assert result.stdout.strip() == expected
    assert history(coded_frames(StreamReader(tmp_path / "s"))) == expected
    assert_same(StreamReader(tmp_path / "s").seek(frames - 1), states[-1])


@pytest.mark.parametrize(
    ("order", "place", "message"),
    [
        ([0, 2, 3], 1, "it does not continue the state after frame 0; "),
        ([1], 0, "it does not continue a state"),
        ([0, 1, 2, 3, 0], 4, "its frame must be above 3, got 0"),
    ],
)
def test_coded_frames__name_file_packet_and_byte_of_frames_out_of_order(
    tmp_path, order, place, message
):
    packets, states = encoded_clip(4)
    chosen = [packets[k] for k in order]
    write(tmp_path / "s", chosen, [states[k] for k in order], every=9)
    at = StreamReader(tmp_path / "s").index()[place][2]
    with pytest.raises(ValueError, match=f"s: packet {place + 1} at byte {at}: {message}"):
        list(coded_frames(StreamReader(tmp_path / "s")))

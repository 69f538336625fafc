"""Reading a stream: in order, from a frame on, from a pipe, and on any number of threads."""

import socket
import threading

import pytest

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import (
    coded_frames,
)
from morgs_mi.codec.reader import StreamReader
from tests.scenes.coded_clip import CAMERAS, assert_same, encoded_clip, write


def test_seek__equals_playing_with_and_without_an_index(tmp_path):
    packets, states = encoded_clip(14)
    path = tmp_path / "s"
    write(path, packets, states)
    whole = path.read_bytes()
    packets_alone = whole[: -(20 + 16 + 16 * (14 + 3))]
    path.write_bytes(packets_alone + bytes(1000))  # as a crash of the system leaves it
    assert len(StreamReader(path).index()) == 14 + 3
    path.write_bytes(packets_alone[:-1])
    assert len(StreamReader(path).index()) == 14 + 2
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

"""The stream file: exact round trips, and detection of every damage."""

import io
import struct
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.codec.container import (
    Packet,
    PacketKind,
    StreamWriter,
    TruncatedStreamError,
    decode_packet,
)
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from tests.scenes.programs import run_script
from tests.scenes.short_clip import sealed

RNG = np.random.default_rng(5)
PACKETS = [
    Packet(
        PacketKind.KEYFRAME,
        0,
        {"means": RNG.normal(size=(4, 3)).astype(np.float32), "ids": np.arange(4, dtype=np.uint32)},
    ),
    Packet(
        PacketKind.RESIDUAL,
        1,
        {"empty": np.zeros((0, 3), np.float32), "code": np.arange(7, dtype=np.uint8)},
    ),
    Packet(PacketKind.RESIDUAL, 2**32 - 1, {"scalar": np.array(np.nan, np.float32)}),
    Packet(PacketKind.RESIDUAL, 3),
]
METADATA = {"seed": 3, "parent": "äé", "preset": {"epochs": [1, 2.5, None]}}


def cameras():
    view = replace(Camera.look_at((1, 2, 3), (0, 0, 0), (0, 0, 1), 55, 40, 30, "cam00"), near=0.2)
    return [view, Camera(view.K + np.diag([1, 1, 0]) / 3, view.viewmat, 41, 31, "cam01")]


def write(path, packets=PACKETS):
    """Write a stream and return its length after the header and after each packet."""
    with StreamWriter(path, cameras(), 29.97, METADATA) as stream:
        ends = [stream.num_bytes]
        for packet in packets:
            ends.append(ends[-1] + stream.write(packet))
            assert path.stat().st_size == ends[-1], "readable while written"
    return ends


def assert_equal(got, expected):
    assert (got.kind, got.frame, list(got.arrays)) == (
        expected.kind,
        expected.frame,
        list(expected.arrays),
    )
    for name, array in expected.arrays.items():
        assert got.arrays[name].dtype == array.dtype
        assert_array_equal(got.arrays[name], array)


def test_stream_reader__round_trips_header_and_packets(tmp_path):
    write(tmp_path / "s")
    stream = StreamReader(tmp_path / "s")
    assert stream.fps == 29.97
    assert stream.metadata == METADATA
    for got, expected in zip(stream.cameras, cameras(), strict=True):
        assert_array_equal(got.K, expected.K)
        assert_array_equal(got.viewmat, expected.viewmat)
        assert (got.name, got.width, got.height, got.near) == (
            expected.name,
            expected.width,
            expected.height,
            expected.near,
        )
    for _ in range(2):
        for got, expected in zip(stream, PACKETS, strict=True):
            assert_equal(got, expected)


def test_packet__is_encoded_once_and_does_not_change():
    array = np.arange(3, dtype=np.uint32)
    packet = Packet(PacketKind.RESIDUAL, 1, {"a": array})
    encoded = packet.encoded
    assert packet.num_bytes == len(encoded)
    assert packet.encoded is encoded
    array[:] = 7  # a copy is encoded
    assert packet.arrays["a"].tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="read-only"):
        packet.arrays["a"][0] = 7


def test_stream_reader__detects_every_truncation_inside_a_packet(tmp_path):
    path = tmp_path / "s"
    ends = write(path)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        intact = sum(end <= length for end in ends)
        got = []
        if length in ends:
            got.extend(StreamReader(path))
            assert len(got) == max(intact - 1, 0)
            continue
        for source in (path, io.BytesIO(whole[:length])):
            got.clear()
            place = rf"packet {intact} at byte \d+: .*; {intact} packet"
            with pytest.raises(TruncatedStreamError, match=place):
                got.extend(StreamReader(source))
            assert len(got) == max(intact - 1, 0)


def with_table(table, rest=b""):
    return sealed(struct.pack("<I", len(table)) + table + rest)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (sealed(b"\0" * 9)[:-1], "should have 29 bytes, got 28"),
        (sealed(b"", kind=7), r"1 \(keyframe\) or 2 \(residual\), got 7"),
        (sealed(b"\xff\xff\xff\xff"), "table of arrays is broken"),
        (with_table(b"[" * 60_000), "table of arrays is broken .*recursion"),
        (with_table(b'[[["a"], "uint8", [1]]]', bytes(1)), r"is declared as uint8 \[1\]"),
        (
            with_table(b'[["a", "uint8", [1]], ["a", "uint8", [1]]]', bytes(2)),
            r"`a` is declared as uint8 \[1\]",
        ),
        (with_table(b'[["a", "uint8", [7]]]', bytes(8)), "describes 32 bytes of 33"),
        (with_table(b'[["a", "object", [1]]]', bytes(8)), "table of arrays is broken"),
        (
            with_table(b'[["a", "uint8", [0, 10000000000000000000000]]]'),
            "integers must have at most 64 bits",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_decode_packet__refuses_inconsistent_packets(data, message):
    with pytest.raises(ValueError, match=message):
        decode_packet(data)


@pytest.mark.parametrize(
    ("packet", "message"),
    [
        (Packet(PacketKind.HEADER, 0), "expected a keyframe or residual .* got Packet.HEADER"),
        (Packet(PacketKind.RESIDUAL, -1), r"of a frame in 0..2\^32-1 .* frame -1"),
        (
            Packet(PacketKind.RESIDUAL, 0, {"a": np.zeros(3)}),
            "arrays of float32, .* got .* of float64",
        ),
    ],
)
def test_stream_writer__refuses_invalid_packets_and_writes_nothing_of_them(
    tmp_path, packet, message
):
    with StreamWriter(tmp_path / "s", cameras(), 30) as stream:
        with pytest.raises(ValueError, match=message):
            stream.write(packet)
        stream.write(PACKETS[0])
    assert len(list(StreamReader(tmp_path / "s"))) == 1


def test_stream_reader__refuses_files_that_are_not_streams(tmp_path):
    path = tmp_path / "s"
    path.write_bytes(b"ply\nformat ascii")
    with pytest.raises(
        ValueError, match=r"expected a stream that starts with b'MORGS-MI' and version 2, got b'ply"
    ):
        StreamReader(path)
    preamble = struct.pack("<8sI", b"MORGS-MI", 2)
    path.write_bytes(preamble + sealed(b"{}", kind=1))
    with pytest.raises(
        ValueError, match="packet 0 at byte 12: the first packet must be the header, got kind 1"
    ):
        StreamReader(path)
    with pytest.raises(ValueError, match="a reader would refuse the header: "):
        StreamWriter(tmp_path / "t", cameras(), 30, {"a": object()})
    assert not (tmp_path / "t").exists()


@pytest.mark.parametrize(
    "entries",
    [[(0, 0, 700)], [(1, 0, 12)], [(1, 0, 2**64 - 1)], [(2, 1, 900), (1, 0, 800)]],
    ids=["kind", "inside the header", "large", "descending"],
)
def test_stream_reader__walks_from_packet_to_packet_where_the_index_is_implausible(
    tmp_path, entries
):
    ends = write(tmp_path / "s")
    packed = b"".join(struct.pack("<IIQ", *entry) for entry in entries)
    data = (tmp_path / "s").read_bytes()[: ends[-1]]
    index = sealed(packed + struct.pack("<Q8s", len(data), b"MORGSIDX"), 3)
    (tmp_path / "s").write_bytes(data + index)
    reader = StreamReader(tmp_path / "s")
    assert [at for *_, at in reader.index()] == ends[:-1]
    assert len(list(reader.near(3))) == len(PACKETS)


def test_stream_reader__reports_a_file_that_became_shorter_than_its_header(tmp_path):
    path = tmp_path / "s"
    write(path)
    reader = StreamReader(path)
    path.write_bytes(path.read_bytes()[:40])
    sentence = r"s: packet 0 at byte 12: the header ended at byte \d+, now the file has 40 bytes: "
    for call in (reader.index, reader.closed, lambda: reader.near(1)):
        with pytest.raises(TruncatedStreamError, match=sentence):
            call()


def test_stream_writer__leaves_complete_packets_on_a_full_disk_and_stays_usable(tmp_path):
    path = tmp_path / "s"
    # A limit on the file size makes a write fail in its middle, as a full disk does.
    program = f"""
import resource
import numpy as np
from morgs_mi.codec.container import Packet, PacketKind, StreamWriter
from tests.scenes.coded_clip import CAMERAS
with StreamWriter({str(path)!r}, CAMERAS, 30) as stream:
    stream.write(Packet(PacketKind.KEYFRAME, 0, {{"a": np.zeros(50, np.float32)}}))
    resource.setrlimit(resource.RLIMIT_FSIZE, (stream.num_bytes + 100, resource.RLIM_INFINITY))
    try:
        stream.write(Packet(PacketKind.RESIDUAL, 1, {{"a": np.zeros(500, np.float32)}}))
    except OSError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
    stream.write(Packet(PacketKind.RESIDUAL, 2))
"""
    result = run_script(program, check=True)
    assert f"{path}: 2" in result.stdout
    assert "bytes of complete packets; free space on the disk" in result.stdout
    assert [packet.frame for packet in StreamReader(path)] == [0, 2]

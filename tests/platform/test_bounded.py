"""Files with headers that claim too much are refused before memory is allocated."""

import os
import struct
import time
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.io.exr import read_exr, write_exr
from morgs_mi.io.images import FolderReader
from morgs_mi.io.ply import read_vertices
from morgs_mi.io.splats import read_splats
from morgs_mi.platform.bounded import (
    MAX_JSON,
    MAX_TOML,
    array_names,
    read_array,
    read_json,
    read_toml,
)


@pytest.fixture(autouse=True)
def bounded_memory():
    """Check that no test allocates more than small files may take."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 250e6


def archived(path):
    return read_array(path, "data")


def image(path):
    return FolderReader.of_files([path])


def npy(shape, dtype="'<f8'", body=bytes(48)):
    """Return a NumPy file with any header."""
    return npy_header(f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}\n", body)


def npy_header(header, body=b""):
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header.encode() + body


def npz(member, name="data.npy"):
    def write(path):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, member)

    return write


def ply(header, body=b""):
    return b"ply\n" + header.encode() + b"end_header\n" + body


def png(width, height):
    header = struct.pack(">4sIIBBBBB", b"IHDR", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + header
        + struct.pack(">I", zlib.crc32(header))
        + bytes(99)
    )


def large_exr(path):
    write_exr(path, {"a": np.zeros((5, 7))})
    window = b"box2i\0" + struct.pack("<I4i", 16, 0, 0, 6, 4)
    claim = b"box2i\0" + struct.pack("<I4i", 16, 0, 0, 39999, 39999)
    path.write_bytes(path.read_bytes().replace(window, claim))


BINARY = "format binary_little_endian 1.0\n"
LARGE = "element vertex 99999999999\nproperty float x\n"
CASES = {
    "npy of many rows": (
        read_array,
        npy("(1000000000000, 17)"),
        "expected a NumPy array, got a broken file",
    ),
    "npy of objects": (
        read_array,
        npy("(1,)", "'|O'", b"cos\nsystem\n."),
        "Object arrays cannot be loaded",
    ),
    "npy of code": (read_array, npy("().__class__"), "expected a NumPy array, got a broken file"),
    "npz bomb": (archived, npz(bytes(250_000_000)), "got a claim of 250000000 bytes of data.npy"),
    "npz of another name": (
        archived,
        npz(npy("(6,)"), "a.npy"),
        "expected an array `data` in a NumPy archive",
    ),
    "deep JSON": (read_json, b"[" * 100_000, "expected JSON, got a broken file"),
    "JSON of empty lists": (
        read_json,
        b"[" + b"[]," * (MAX_JSON // 3) + b"0]",
        "expected at most 64000000 bytes, got 64000002",
    ),
    "JSON of many objects": (
        read_json,
        b"[" + b'{"a":1},' * 2_000_000 + b"0]",
        "expected content that fits its 16000003 bytes, got a claim of many small objects and list",
    ),
    "TOML of a long key": (read_toml, b"a" + b".a" * 20_000 + b"=1", "keys of at most 20 dots"),
    "TOML of a long number": (read_toml, b"a = 0x" + b"f" * 6000, "numbers below 1000 digits"),
    "TOML of open strings": (
        read_toml,
        b'a = """' + b'\\"""' * 60_000,
        "expected TOML, got a broken file",
    ),
    "JSON in Latin-1": (
        read_json,
        '"é"'.encode("latin-1"),
        "expected text in UTF-8, got a broken file",
    ),
    "TOML of many rows": (
        read_toml,
        b"x = [" + b"1," * MAX_TOML + b"]",
        "expected at most 256000 bytes, got 512006",
    ),
    "PLY of many vertices": (
        read_vertices,
        ply(BINARY + LARGE),
        "vertex.*early end-of-file",
    ),
    "PLY of empty lists": (
        read_vertices,
        ply(BINARY + "element face 3000000\nproperty list uchar int i\n" + LARGE, bytes(3_000_000)),
        "or has lists, as of the faces",
    ),
    "compressed PLY of empty rows": (
        read_splats,
        ply(
            BINARY + "element chunk 99999999999\nelement vertex 1\nproperty uint packed_position\n",
            bytes(4),
        ),
        "expected a compressed PLY",
    ),
    "EXR of many pixels": (read_exr, large_exr, "got a claim of 40000x40000 pixels of 1 channels"),
    "PNG of many pixels": (
        image,
        png(30000, 30000),
        "0.png: expected content .* got a claim of 30000x30000 pixels",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(("read", "content", "message"), CASES.values(), ids=CASES)
def test_readers__refuse_a_hostile_file_in_one_sentence(tmp_path, read, content, message):
    path = tmp_path / ("0.ply" if read is read_splats else "0.png")
    content(path) if callable(content) else path.write_bytes(content)
    with pytest.raises((ValueError, OSError), match=message) as caught:
        read(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("text", ["{} = 1", "a = 1\n[{}]", "[[ {} ]]", "a = [{{{} = 1}}]"])
def test_read_toml__refuses_keys_of_more_than_twenty_dots(tmp_path, text):
    path = tmp_path / "a.toml"
    for part in ("x", "-9", '""', "''", '"a.b c"', r'"\""', "'\"'", "x ", "\t'x' "):
        path.write_text(text.format(".".join(21 * [part])))
        assert read_toml(path)
        path.write_text(text.format(".".join(22 * [part])))
        with pytest.raises(ValueError, match=r"a\.toml: expected keys of at most 20 dots, got mo"):
            read_toml(path)


@pytest.mark.parametrize(
    "text",
    ["a" * 250_000, '"' * 250_000, '"' + '\\"' * 120_000, "a" + " " * 250_000, "a. " * 80_000],
    ids=lambda text: text[:9],
)
def test_read_toml__takes_no_long_time(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    begin = time.process_time()
    with pytest.raises(ValueError, match=r"a\.toml: expected"):
        read_toml(tmp_path / "a.toml")
    assert time.process_time() - begin < 2


@pytest.mark.parametrize("read", [read_array, read_json])
def test_readers__refuse_pipes_and_folders(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path):
        with pytest.raises(
            ValueError, match=f"^{path}: expected a.*got a folder, a pipe or a device"
        ):
            read(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_readers__read_utf_8_with_and_without_a_byte_order_mark(tmp_path, encoding):
    (tmp_path / "a").write_bytes('a = "é"\r\n[b]\r\n'.encode(encoding))
    assert read_toml(tmp_path / "a") == {"a": "é", "b": {}}
    (tmp_path / "a").write_bytes('{"a":\r\n"é"}'.encode(encoding))
    assert read_json(tmp_path / "a") == {"a": "é"}


@pytest.mark.parametrize("order", "CF")
def test_read_array__inverts_save(tmp_path, order):
    array = np.asarray(np.arange(6.0).reshape(2, 3), order=order)
    np.save(tmp_path / "a.npy", array)
    np.savez_compressed(tmp_path / "a.npz", data=array, scalar=np.int64(3))
    assert_array_equal(read_array(tmp_path / "a.npy"), array)
    assert_array_equal(read_array(tmp_path / "a.npz", "data"), array)
    assert read_array(tmp_path / "a.npz", "scalar") == 3


def test_array_names__lists_an_archive_or_names_a_broken_one(tmp_path):
    np.savez(tmp_path / "a.npz", data=np.zeros(2), scalar=np.int64(3))
    assert array_names(tmp_path / "a.npz") == ["data", "scalar"]
    (tmp_path / "a.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"a.npz: expected a NumPy archive, got a broken file"):
        array_names(tmp_path / "a.npz")

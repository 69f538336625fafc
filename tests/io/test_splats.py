"""Files of other tools by their names, and `.splat`."""

import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.core.color_space import SH_C0
from morgs_mi.io.compressed_ply import write_compressed_ply
from morgs_mi.io.splats import read_splats
from morgs_mi.playback.streams import open_stream
from morgs_mi.testing import assert_close
from tests.scenes.changing_splats import splats

RECORD = struct.Struct("<6f8B")


def test_read_splats__reads_a_splat_file(tmp_path):
    records = [(1, 2, 3, 0.5, 0.25, 1, 255, 0, 51, 204, 128, 255, 128, 128), (0,) * 10 + (128,) * 4]
    (tmp_path / "a.SPLAT").write_bytes(b"".join(RECORD.pack(*record) for record in records))
    gaussians = read_splats(tmp_path / "a.SPLAT")
    raw = gaussians.numpy()
    assert_array_equal(raw["means"], [[1, 2, 3], [0, 0, 0]])
    assert_close(np.asarray(gaussians.scales)[0], (0.5, 0.25, 1), rtol=1e-6)
    assert_close(0.5 + SH_C0 * raw["sh_coeffs"][0, 0], (1, 0, 0.2), atol=1e-6)
    assert_close(np.asarray(gaussians.opacities), (0.8, 0), atol=2e-6)
    assert_close(raw["quats"], [[0, 127 / 128, 0, 0], [0, 0, 0, 0]], atol=1e-7)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply"])
def test_read_splats__recognises_a_compressed_ply(tmp_path, name):
    write_compressed_ply(tmp_path / name, splats())
    assert len(read_splats(tmp_path / name)) == len(splats())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.splat", bytes(33), "expected 32 bytes a Gaussian, got 33"),
        (
            "a.splat",
            RECORD.pack(*(0,) * 14) + RECORD.pack(np.nan, *(0,) * 13),
            "others in 1 of 2 Gaussians .centre of 1.",
        ),
        ("a.ply", b"", "expected a complete PLY file, .* its header does not end"),
        ("a.ply", b"ply\nformat ascii 1.0\n", "its header does not end"),
    ],
)
def test_read_splats__names_what_is_broken(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_splats(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.parametrize("name", ["a.spz", "meta.json", "e.ply.gz", "a.GLB", "chkpnt30000.pth"])
def test_read_splats__names_what_converts_other_formats(tmp_path, name):
    (tmp_path / name).touch()
    for door in (open_stream, read_splats):
        with pytest.raises(
            ValueError, match=rf"{name}: expected .*\.ply, .*splat, got {name}; .*SuperSplat"
        ):
            door(tmp_path / name)


def test_open_stream__names_what_to_do_with_a_folder_of_gaussians(tmp_path):
    (tmp_path / "1.ply").touch()
    with pytest.raises(
        ValueError, match=r"got a folder with 1\.ply; name one of them, or .*import"
    ):
        open_stream(tmp_path)


def test_read_splats__names_a_missing_file(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"a\.splat: expected a file with Gaussians, found none"
    ):
        read_splats(tmp_path / "a.splat")

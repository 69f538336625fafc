"""Compressed PLY: errors within the steps of the layout, bits of the layout, and messages for
broken files.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.lib.recfunctions import rename_fields
from plyfile import PlyData, PlyElement

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.compressed_ply import read_compressed_ply, write_compressed_ply
from morgs_mi.io.splats import read_splats
from morgs_mi.testing import assert_close
from tests.scenes.changing_splats import splats


def round_trip(path, gaussians):
    write_compressed_ply(path, gaussians)
    return read_compressed_ply(path)


@pytest.mark.parametrize("degree", [0, 3])
def test_read_compressed_ply__returns_what_was_written_up_to_the_steps(tmp_path, degree):
    gaussians = splats(300, degree)
    result = round_trip(tmp_path / "g.compressed.ply", gaussians)
    old = gaussians.numpy()
    new = result.numpy()
    extent = np.ptp(old["means"], axis=0).max()
    assert_close(new["means"], old["means"], atol=0.51 * extent / 1023)
    assert_close(
        new["log_scales"],
        old["log_scales"],
        atol=0.51 * np.ptp(old["log_scales"], axis=0).max() / 1023,
    )
    assert_close(np.asarray(result.opacities), np.asarray(gaussians.opacities), atol=0.51 / 255)
    units = old["quats"] / np.linalg.norm(old["quats"], axis=1, keepdims=True)
    # The largest component follows from three with steps of sqrt(2) / 1023 and is at least a half.
    assert_close(np.abs((units * new["quats"]).sum(axis=1)), 1, atol=1e-5)
    assert_close(
        new["sh_coeffs"][:, 0],
        old["sh_coeffs"][:, 0],
        atol=0.51 * np.ptp(old["sh_coeffs"][:, 0]) / 255,
    )
    assert_close(new["sh_coeffs"][:, 1:], old["sh_coeffs"][:, 1:], atol=4.01 / 256)


def test_write_compressed_ply__has_the_bits_of_the_layout(tmp_path):
    """Two Gaussians at the ends of the bounds, and one between them."""
    gaussians = Gaussians(
        means=np.array([[0, 0, 0], [1, 2, 4], [0.5, 1, 1]]),
        log_scales=np.array([[-3, -3, -3], [-1, -1, -1], [-2, -3, -1]]),
        quats=np.array([[1, 0, 0, 0], [0, 0, -2, 0], [1, 1, 1, -1.0001]]),
        logit_opacities=np.array([-100, 0, 100]),
        sh_coeffs=np.array([[[-1, 0, 0]], [[1, 1, 0]], [[0.2, 0.5, 0]]]),
    )
    write_compressed_ply(tmp_path / "g.compressed.ply", gaussians)
    file = PlyData.read(tmp_path / "g.compressed.ply")
    assert [element.name for element in file.elements] == ["chunk", "vertex"]
    assert [file["chunk"][name][0] for name in ("max_z", "min_scale_y")] == [4, -3]
    vertices = file["vertex"]
    assert vertices["packed_position"].tolist() == [0, 2**32 - 1, 1024 << 21 | 512 << 11 | 512]
    assert vertices["packed_scale"].tolist() == [0, 2**32 - 1, 1024 << 21 | 2047]
    zero = 512  # round(1023 / 2) upwards
    half = 512 + 362  # sqrt(1/2) / 2 of 1023 beyond it
    rotations = vertices["packed_rotation"].tolist()
    assert rotations[:2] == [
        zero << 20 | zero << 10 | zero,
        2 << 30 | zero << 20 | zero << 10 | zero,
    ]
    low = 1023 - half
    assert rotations[2] >> 30 == 3
    assert rotations[2] & 1023 == pytest.approx(low, abs=1)
    colors = [color.to_bytes(4, "big") for color in vertices["packed_color"].tolist()]
    assert [[*color] for color in colors] == [[0, 0, 0, 0], [255, 255, 0, 128], [153, 128, 0, 255]]


def test_write_compressed_ply__has_bounds_for_each_256(tmp_path):
    far = 1000 * (np.arange(600) // 256)[:, None]
    means = far + np.random.default_rng(0).random((600, 3))
    result = round_trip(tmp_path / "g.compressed.ply", replace(splats(600), means=means))
    assert_close(result.numpy()["means"], means, atol=0.6 / 1023)


def test_write_compressed_ply__writes_a_file_of_no_gaussians(tmp_path):
    assert len(round_trip(tmp_path / "g.compressed.ply", splats(0))) == 0


def changed(path, change):
    file = PlyData.read(path)
    tables = {element.name: np.array(element.data) for element in file.elements}
    change(tables)
    elements = [PlyElement.describe(table, name) for name, table in tables.items()]
    PlyData(elements, byte_order="<").write(str(path))


def infinite(tables):
    tables["chunk"]["max_x"][0] = np.inf


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("chunk"), "expected a compressed PLY .*, got .* of min_x, "),
        (
            lambda t: t.update(chunk=t["chunk"][:1]),
            "expected .* of 300 Gaussians, .* chunks of 256, .*, got .* of min_x, ",
        ),
        (
            lambda t: t.update(sh=t["sh"][:9]),
            "expected .* of 300 Gaussians, .* got 9 SH coefficients and .* of f_rest_0, ",
        ),
        (
            lambda t: t.update(sh=rename_fields(t["sh"], {"f_rest_8": "f_rest_9"})),
            "got 9 SH coefficients and another number or type of f_rest_8",
        ),
        (infinite, "others in 256 of 300 Gaussians .centre of 0, 1, 2 and 253 more."),
    ],
)
def test_read_compressed_ply__names_what_is_broken(tmp_path, change, message):
    path = tmp_path / "g.compressed.ply"
    write_compressed_ply(path, splats(300))
    changed(path, change)
    with pytest.raises(ValueError, match=message) as caught:
        read_splats(path)
    assert str(path) in str(caught.value)

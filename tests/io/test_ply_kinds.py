"""PLY files of other methods: drawn as what they are, or named."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from plyfile import PlyData, PlyElement

from morgs_mi.io.ply import read_ply
from tests.io.test_ply import random_gaussians, table

N = 20
RNG = np.random.default_rng(0)


def write(path, without=(), **more):
    """Write Gaussians without some properties and with others, and return the path."""
    records = table(random_gaussians(N, degree=1))
    columns = {name: records[name] for name in records.dtype.names if name not in without} | more
    rows = np.empty(N, [(name, np.asarray(values).dtype.str) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))
    return path


def varying():
    return RNG.uniform(0, 1, N).astype("f4")


def same(value=0):
    return np.full(N, value, "f4")


def columns(*names):
    return {name: varying() for name in names}


def test_read_ply__draws_discs_with_a_thin_third_axis(tmp_path, caplog):
    gaussians = read_ply(write(tmp_path / "a.ply", without=("scale_2",)))
    expected = random_gaussians(N, degree=1)
    assert_array_equal(
        gaussians.numpy()["log_scales"][:, :2], expected.numpy()["log_scales"][:, :2]
    )
    assert np.exp(gaussians.numpy()["log_scales"][:, 2]).max() < 1e-20
    assert "a.ply: it has discs of 2D Gaussian Splatting" in caplog.text


SPACETIME = {
    "trbf_center",
    "trbf_scale",
    *(f"motion_{i}" for i in range(9)),
    *(f"omega_{i}" for i in range(4)),
}
TIMESTAMPS = {
    "spacetime gaussians": columns(*SPACETIME),
    "4dgs": columns("t", "scale_t", "rot_r_0", "rot_r_1", "rot_r_2", "rot_r_3"),
    "frame": {"frame": np.arange(N, dtype="i4")},
    "one timestamp that moves": {"trbf_center": same(0.5), **columns("omega_0")},
    "not a number": {"t": same(np.nan)},
}


@pytest.mark.parametrize("kind", TIMESTAMPS)
def test_read_ply__refuses_several_timestamps(tmp_path, kind):
    path = write(tmp_path / "a.ply", **TIMESTAMPS[kind])
    with pytest.raises(
        ValueError,
        match=r"a\.ply: expected the Gaussians of one timestamp, got several timestamps.*import",
    ):
        read_ply(path)


@pytest.mark.parametrize(
    "more", [{"time": same(3)}, {"frame": np.full(N, 7, "i4")}, {"motion_0": same()}]
)
def test_read_ply__reads_gaussians_of_one_timestamp(tmp_path, more):
    assert len(read_ply(write(tmp_path / "a.ply", **more))) == N


@pytest.mark.parametrize(
    ("without", "more", "message"),
    [
        (
            ("f_dc_0",),
            columns("f_offset_0", "f_anchor_feat_0"),
            "got anchors of Scaffold-GS, .* .f_anchor_feat_0, f_off",
        ),
        (
            ("scale_1", "scale_2"),
            {},
            "without scale_1, scale_2, as of a mesh or a point cloud; export the Gaussians",
        ),
        (
            ("scale_0",),
            {"scale_0": np.zeros(N, "u1")},
            "got integers, which stand for entries of a codebook .scale_0",
        ),
        (
            (),
            columns("filter_3D"),
            "got the 3D filter of Mip-Splatting .*; export fused Gaussians",
        ),
        (
            (),
            columns(*(f"f_rest_{i}" for i in range(72))),
            "23, 44 or none, got 72 of them",
        ),
    ],
)
def test_read_ply__names_other_kinds(tmp_path, without, more, message):
    with pytest.raises(ValueError, match=message):
        read_ply(write(tmp_path / "a.ply", without=without, **more))


def test_read_ply__names_what_may_change_the_image_once_in_a_folder(tmp_path, caplog):
    for name in ("a.ply", "b.ply"):
        read_ply(
            write(
                tmp_path / name, **columns("nx", "label", "object_id", "red", "beta", "sg_axis_0")
            )
        )
    (message,) = [record.getMessage() for record in caplog.records]
    assert message.endswith(
        "a.ply: it is drawn without beta, sg_axis_0, which may change the image."
    )


def test_read_ply__names_a_deformation_network_beside_the_gaussians(tmp_path, caplog):
    (tmp_path / "deformation.pth").touch()
    read_ply(write(tmp_path / "point_cloud.ply"))
    assert "point_cloud.ply: it is drawn without deformation.pth" in caplog.text

"""PLY: exact round trips, files of other tools, and messages for broken files."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields, unstructured_to_structured
from numpy.testing import assert_allclose
from plyfile import PlyData, PlyElement

from morgs_mi import ellipsoids
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.io.ply import read_ply, write_ply
from morgs_mi.io.splats import read_splats
from morgs_mi.testing import assert_close
from tests.scenes.gaussians import RAW, make_unit_scene, to_gaussians


def random_gaussians(n=20, degree=3):
    """Return Gaussians with the attributes of a PLY file."""
    raw = make_unit_scene(degree, n)
    return to_gaussians(
        {name: raw[name] for name in RAW if name not in ("motion", "logit_confidence")}
    )


def table(gaussians):
    """Return one record per Gaussian in the layout of other tools."""
    raw = gaussians.numpy()
    harmonics = raw["sh_coeffs"].transpose(0, 2, 1)  # by colour
    rest = harmonics[..., 1:].reshape(len(gaussians), -1)
    opacities = raw["logit_opacities"][:, None]
    columns = [raw["means"], harmonics[..., 0], rest, opacities, raw["log_scales"], raw["quats"]]
    names = [
        *["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"],
        *(f"f_rest_{i}" for i in range(rest.shape[1])),
        *["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"],
    ]
    values = np.concatenate(columns, axis=1)
    return unstructured_to_structured(values, np.dtype([(name, "f4") for name in names]))


def assert_same(a, b, **tolerance):
    for name, value in a.numpy().items():
        assert_allclose(b.numpy()[name], value, err_msg=name, **({"rtol": 0} | tolerance))


@pytest.mark.parametrize("degree", [0, 3])
def test_read_ply__inverts_write_ply_with_all_attributes(tmp_path, degree):
    gaussians = replace(
        to_gaussians(make_unit_scene(degree)), offset=np.arange(30.0).reshape(10, 3)
    )
    write_ply(tmp_path / "g.ply", gaussians, layout="mitsuba")
    copy = read_ply(tmp_path / "g.ply")
    assert copy.items().keys() == gaussians.items().keys()
    # Logits of float32 activations.
    assert_same(gaussians, copy, rtol=1e-5, atol=1e-6)


def test_write_ply__refuses_values_that_are_not_finite(tmp_path):
    gaussians = replace(to_gaussians(make_unit_scene(0)), means=np.full((10, 3), np.nan))
    with pytest.raises(ValueError, match="must be finite, got others in `means`"):
        write_ply(tmp_path / "g.ply", gaussians)
    assert not (tmp_path / "g.ply").exists()


def test_write_ply__stores_the_attributes_of_mitsuba(tmp_path):
    gaussians = to_gaussians(make_unit_scene(1, 2))
    write_ply(tmp_path / "g.ply", gaussians, layout="mitsuba")
    attributes = dict(
        mi.traverse(mi.load_dict({"type": "ellipsoids", "filename": str(tmp_path / "g.ply")}))
    )
    for name, value in ellipsoids(gaussians).items():
        if name != "type":
            assert_close(attributes[name], np.ravel(value), atol=2e-6)  # of the unit quaternions


def test_read_ply__names_an_invalid_motion(tmp_path):
    write_ply(tmp_path / "g.ply", to_gaussians(make_unit_scene()), layout="mitsuba")
    file = PlyData.read(tmp_path / "g.ply", mmap=False)
    file["vertex"]["motion_1"][3] = np.nan
    file.write(tmp_path / "g.ply")
    with pytest.raises(ValueError, match=r"others in 1 of 10 Gaussians \(motion of 3\)"):
        read_splats(tmp_path / "g.ply")


def test_write_ply__has_the_layout_of_other_tools(tmp_path):
    gaussians = random_gaussians(2, degree=1)
    write_ply(tmp_path / "g.ply", gaussians)
    records = table(gaussians)
    names = records.dtype.names
    order = (*names[:3], "nx", "ny", "nz", *names[3:])
    head, _, body = (tmp_path / "g.ply").read_bytes().partition(b"end_header\n")
    assert head.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 2",
        *(f"property float {name}" for name in order),
    ]
    assert len(body) == 2 * 4 * len(order)
    first = dict(zip(order, np.frombuffer(body, "<f4")[: len(order)], strict=True))
    assert_close([first[name] for name in names], records[0].tolist(), atol=3e-7)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize(
    "form",
    [{"text": True}, {"byte_order": ">"}],
    ids=["text", "big"],
)
def test_read_ply__accepts_files_of_other_tools(tmp_path, degree, form):
    gaussians = random_gaussians(degree=degree)
    records = table(gaussians)
    # No normals, properties in another order and of other types, unknown properties, and a second
    # element.
    extra = [("label", "u1"), *reversed(records.dtype.descr), ("time", "f8")]
    vertices = np.zeros(len(records), extra)
    for name in records.dtype.names:
        vertices[name] = records[name]
    camera = PlyElement.describe(np.zeros(1, [("focal", "f4")]), "camera")
    PlyData(
        [camera, PlyElement.describe(vertices, "vertex")], comments=["by another tool"], **form
    ).write(str(tmp_path / "g.ply"))
    # 9 digits may be fewer.
    assert_same(gaussians, read_ply(tmp_path / "g.ply"), rtol=1e-6 if "text" in form else 0)


def test_read_ply__bounds_the_infinite_numbers_of_opaque_and_flat_gaussians(tmp_path, caplog):
    records = table(random_gaussians(3))
    records["opacity"][:2] = np.inf, -np.inf
    records["scale_2"][0] = -np.inf
    PlyData([PlyElement.describe(records, "vertex")]).write(str(tmp_path / "g.ply"))
    gaussians = read_splats(tmp_path / "g.ply")
    assert not caplog.records
    assert_close(np.array(gaussians.opacities)[:2], [1, 0], atol=1e-6)
    assert 0 < np.array(gaussians.scales)[0, 2] < 1e-29
    assert gaussians.numpy()["logit_opacities"][2] == records["opacity"][2]


def test_write_ply__writes_no_rotation_for_a_zero_quaternion(tmp_path):
    write_ply(
        tmp_path / "g.ply",
        Gaussians(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 4)), [0], np.zeros((1, 1, 3))),
    )
    assert read_ply(tmp_path / "g.ply").numpy()["quats"].tolist() == [[1, 0, 0, 0]]


def without(*names):
    return lambda records: repack_fields(
        records[[name for name in records.dtype.names if name not in names]]
    )


@pytest.mark.parametrize("size", [60, -5])
def test_read_ply__names_a_truncated_file(tmp_path, size):
    path = tmp_path / "g.ply"
    write_ply(path, random_gaussians())
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ValueError, match=r"g\.ply: expected a complete PLY file"):
        read_ply(path)


def test_write_ply__writes_a_file_of_no_gaussians(tmp_path):
    write_ply(tmp_path / "g.ply", random_gaussians(0))
    assert len(read_ply(tmp_path / "g.ply")) == 0

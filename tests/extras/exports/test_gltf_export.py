"""glTF: the file is read by a reader written from the specifications, and renders to the same
image.
"""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.core.color_space import SH_C0, TRANSFER, decode_light
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.extras.exports.gltf_export import LINEAR, glb, gltf_axes, write_gltf
from morgs_mi.render.rasterize import rasterize
from morgs_mi.testing import assert_close
from tests.cli.conftest import run
from tests.reference import sh_basis
from tests.scenes.changing_splats import rig, splats, write_stream

__all__ = ["run"]
KHR = "KHR_gaussian_splatting"
SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
# KHR_gaussian_splatting's table of attributes; all may be float, with the component type 5126. All
# others are VEC3.
TYPES = {f"{KHR}:ROTATION": "VEC4", f"{KHR}:OPACITY": "SCALAR", "COLOR_0": "VEC4"}


def read_glb(data):
    """Return the JSON and binary chunks of a .glb file, according to glTF 2.0's section on the
    binary format.
    """
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    chunks = []
    at = 12
    while at < len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        assert (at % 4, size % 4) == (0, 0)
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    assert at == len(data)
    assert [kind for kind, _ in chunks] == [b"JSON", b"BIN\0"]
    document = json.loads(chunks[0][1].decode())
    assert 0 <= len(chunks[1][1]) - document["buffers"][0]["byteLength"] <= 3
    return document, chunks[1][1]


def attributes(document, binary):
    """Return the arrays of the one primitive, checked against glTF 2.0's rules on accessors and
    buffer views.
    """
    arrays = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        assert accessor["componentType"] == 5126
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        width = SIZES[accessor["type"]]
        assert start % 4 == 0
        assert "byteStride" not in view
        assert accessor["count"] * width * 4 <= view["byteLength"]
        assert (
            view.get("byteOffset", 0) + view["byteLength"] <= document["buffers"][0]["byteLength"]
        )
        assert view["target"] == 34962
        arrays[name] = np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(
            -1, width
        )
    assert len({len(array) for array in arrays.values()}) == 1
    return arrays


def gaussians_of(arrays):
    harmonics = sorted(name for name in arrays if ":SH_DEGREE_" in name)
    return Gaussians.from_activated(
        arrays["POSITION"],
        arrays[f"{KHR}:SCALE"],
        arrays[f"{KHR}:ROTATION"][:, [3, 0, 1, 2]],  # glTF's order is xyzw
        arrays[f"{KHR}:OPACITY"][:, 0],
        np.stack([arrays[name] for name in harmonics], axis=1),
    )


@pytest.mark.parametrize("degree", [0, 3])
def test_glb__conforms_to_the_extension(degree):
    gaussians = replace(splats(degree=degree), sh_coeffs=np.zeros((40, (degree + 1) ** 2, 3)))
    document, binary = read_glb(glb(gaussians, gltf_axes(rig())))
    assert document["asset"]["version"] == "2.0"
    assert document["extensionsUsed"] == [KHR]
    assert "uri" not in document["buffers"][0]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][KHR]["kernel"] == "ellipse"
    assert primitive["extensions"][KHR]["colorSpace"] == "srgb_rec709_display"
    arrays = attributes(document, binary)
    bands = {f"{KHR}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)}
    assert arrays.keys() == {"POSITION", f"{KHR}:SCALE", *TYPES, *bands}
    for name, index in primitive["attributes"].items():
        assert document["accessors"][index]["type"] == TYPES.get(name, "VEC3")
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert_array_equal(position["min"], arrays["POSITION"].min(0))
    assert_array_equal(position["max"], arrays["POSITION"].max(0))
    assert_close(np.linalg.norm(arrays[f"{KHR}:ROTATION"], axis=1), 1, atol=1e-6)
    assert arrays[f"{KHR}:SCALE"].min() >= 0
    # The fallback colour is linear: sRGB's 0.5 is 0.21404 in linear light.
    assert_close(arrays["COLOR_0"][:, :3], 0.21404, atol=1e-5)
    for opacity in (arrays[f"{KHR}:OPACITY"], arrays["COLOR_0"][:, 3:]):
        assert opacity.min() > 0.2
        assert opacity.max() <= 1


@pytest.mark.parametrize("degree", [0, 3])
def test_write_gltf__renders_the_same_image_in_gltf_axes(tmp_path, degree):
    gaussians = splats(degree=degree)
    camera = rig()[0]
    rotation = np.eye(4)
    rotation[:3, :3] = gltf_axes(rig()).T
    write_gltf(tmp_path / "g.glb", gaussians, gltf_axes(rig()))
    document, binary = read_glb((tmp_path / "g.glb").read_bytes())
    extras = document["nodes"][0]["extras"]
    assert_array_equal(extras["world_from_gltf"], rotation[:3, :3])
    exported = gaussians_of(attributes(document, binary))
    image = rasterize(exported, replace(camera, viewmat=camera.viewmat @ rotation)).color
    # The rotation rounds the float32 attributes once more.
    assert_close(image, rasterize(gaussians, camera).color, atol=2e-4)


def test_glb__has_linear_light_in_every_direction():
    # Colours from 0.2 to 2 and small changes over the directions, as the slope of the curve holds.
    coefficients = splats(degree=1).numpy()["sh_coeffs"] * np.float32([[0], [0.01], [0.01], [0.01]])
    coefficients[:, 0] = (np.linspace(0.2, 2, 120).reshape(40, 3) - 0.5) / SH_C0
    gaussians = replace(splats(degree=1), sh_coeffs=coefficients)
    document, binary = read_glb(glb(gaussians, np.eye(3), LINEAR))
    arrays = attributes(document, binary)
    light = gaussians_of(arrays).numpy()["sh_coeffs"]
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        basis = np.array(sh_basis(direction, 1))
        encoded, linear = (0.5 + np.einsum("k,nkc->nc", basis, c) for c in (coefficients, light))
        assert_close(linear / decode_light(encoded), 1, atol=2e-3)
    mean = decode_light(0.5 + SH_C0 * coefficients[:, 0])
    assert_close(0.5 + SH_C0 * light[:, 0], mean, rtol=1e-5)
    assert_close(arrays["COLOR_0"][:, :3], np.minimum(mean, 1), atol=1e-5)


@pytest.mark.parametrize(
    ("metadata", "color_space"),
    [
        ({}, "srgb_rec709_display"),
        ({"transfer": {"name": TRANSFER, "display_exposure": -1}}, "lin_rec709_display"),
    ],
    ids=["8 bits", "linear light"],
)
def test_export_gltf__names_the_colour_space_of_the_recording(tmp_path, run, metadata, color_space):
    write_stream(tmp_path / "s.morgs", 1, metadata=metadata)
    assert run("export", "gltf", tmp_path / "s.morgs", tmp_path / "g.glb")[0] == 0
    (primitive,) = read_glb((tmp_path / "g.glb").read_bytes())[0]["meshes"][0]["primitives"]
    assert primitive["extensions"][KHR]["colorSpace"] == color_space


def test_gltf_axes__have_y_up_and_the_cameras_at_positive_z():
    axes = gltf_axes(rig())
    assert_close(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    # The world's up is nearly y, since the cameras look down a little.
    assert (axes @ [0, 0, 1])[1] > 0.95
    assert (axes @ rig()[1].position)[2] > 3  # the cameras are at positive z


def test_glb__rejects_an_empty_set():
    with pytest.raises(ValueError, match="at least one Gaussian was expected"):
        glb(splats().select(np.zeros(0, int)), np.eye(3))

"""glTF files: arrays that are read, and files that are refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.io.gltf import read_gltf
from tests.assertions import assert_close
from tests.scenes.animated_gltf import COLORS, Builder, column, glb_bytes, model, write_glb, write_gltf


def test_read_gltf__returns_meshes_skins_materials_and_animations(tmp_path: Path) -> None:
    found = read_gltf(write_glb(tmp_path / "model.glb"))
    expected, (skinned,) = column(), found.meshes[0]
    for name in ("positions", "normals", "uvs", "joints", "weights"):
        assert_close(getattr(skinned, name), expected[name], atol=1e-7)
    np.testing.assert_array_equal(skinned.faces.ravel(), expected["faces"])
    assert found.meshes[1][0].targets.shape == (1, 4, 3)
    assert found.meshes[2][0].uvs is None
    assert found.skins[0].joints.tolist() == [1, 2]
    assert_close(found.skins[0].inverse_bind[1][:3, 3], [0, -1, 0], atol=0)
    assert [(a.name, a.duration) for a in found.animations] == [("bend", 1.0), ("rest", 0.0)]
    kinds = [(c.node, c.path, c.interpolation, c.values.shape) for c in found.animations[0].channels]
    assert kinds == [
        (2, "rotation", "LINEAR", (2, 4)),
        (4, "weights", "LINEAR", (2, 1)),
        (5, "translation", "CUBICSPLINE", (2, 3, 3)),
        (5, "scale", "STEP", (2, 3)),
    ]
    texture = found.materials[0].color_texture
    assert texture is not None
    assert texture.wrap == "clamp"
    np.testing.assert_array_equal(texture.image[::8, ::8], COLORS)
    assert found.materials[1].color == (0.2, 0.4, 0.6)
    assert [node.drawn for node in found.nodes] == [True, False, False, True, True, True], "a child is drawn too"
    assert found.nodes[4].weights.tolist() == [0.5], "the default of the mesh"


@pytest.mark.parametrize("embedded", [True, False])
def test_read_gltf__reads_buffers_in_the_file_and_beside_it(tmp_path: Path, embedded: bool) -> None:
    found = read_gltf(write_gltf(tmp_path / "model.gltf", model(), embedded))
    assert_close(found.meshes[0][0].positions, column()["positions"], atol=1e-7)


def test_read_gltf__reads_quantised_strided_and_sparse_accessors(tmp_path: Path) -> None:
    b = model()
    accessors, positions = b.document["accessors"], column()["positions"]
    skinned = b.document["meshes"][0]["primitives"][0]["attributes"]
    b.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    skinned["POSITION"] = b.array(np.round(positions / 2 * 32767), "i2", normalized=True)
    # Interleaved with 4 bytes of padding.
    rows = np.zeros((len(positions), 4), "<f4")
    rows[:, :3] = column()["normals"]
    accessors[skinned["NORMAL"]]["bufferView"] = b.view(rows.tobytes(), byteStride=16)
    target = b.document["meshes"][1]["primitives"][0]["targets"][0]
    indices, values = (
        b.view(np.array([1, 3], "<u2").tobytes()),
        b.view(np.array([(1, 2, 3), (4, 5, 6)], "<f4").tobytes()),
    )
    del accessors[target["POSITION"]]["bufferView"]
    accessors[target["POSITION"]]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": indices, "componentType": 5123},
        "values": {"bufferView": values},
    }
    found = read_gltf(write_glb(tmp_path / "model.glb", b))
    assert_close(2 * found.meshes[0][0].positions, positions, atol=1e-4)
    assert_close(found.meshes[0][0].normals, column()["normals"], atol=0)
    assert found.meshes[1][0].targets[0].tolist() == [[0, 0, 0], [1, 2, 3], [0, 0, 0], [4, 5, 6]]


def primitive(b: Builder) -> dict:
    return b.document["meshes"][0]["primitives"][0]


def zeros(b: Builder, count: int) -> int:
    """Append an accessor [count, 3] that takes no bytes of the file."""
    b.document["accessors"].append({"count": count, "type": "VEC3", "componentType": 5126})
    return len(b.document["accessors"]) - 1


def sparse(b: Builder, dtype: str) -> None:
    """Replace the last vertex of the skinned mesh, by a place before the first."""
    places, values = b.view(np.array([-1], dtype).tobytes()), b.view(np.zeros(3, "<f4").tobytes())
    kind = {"i1": 5120, "f4": 5126}[dtype]
    b.document["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": places, "componentType": kind},
        "values": {"bufferView": values},
    }


# What is wrong, how, and what is said about it.
WRONG: dict[str, tuple[Callable[[Builder], object], str]] = {
    "draco": (
        lambda b: b.document.update(extensionsRequired=["KHR_draco_mesh_compression"]),
        "expected a file without required extensions, got KHR_draco_mesh_compression; export it without compression",
    ),
    "version": (lambda b: b.document.update(asset={"version": "1.0"}), "expected glTF 2.0, got 1.0"),
    "lines": (lambda b: primitive(b).update(mode=1), "mesh 0: expected triangles, got primitives of mode 1"),
    "rotations": (
        lambda b: b.document["animations"][0]["samplers"][0].update(output=b.array(np.zeros((2, 4)))),
        "animation 'bend': expected quaternions of length 1 as rotations, got zeros",
    ),
    "rotation": (
        lambda b: b.document["nodes"][1].update(rotation=[0, 0, 0, 0]),
        "node 1: expected quaternions of length 1",
    ),
    "targets": (
        lambda b: b.document["meshes"][1]["primitives"].append(b.document["meshes"][2]["primitives"][0]),
        r"mesh 1: expected as many morph targets in all its primitives, got \[0, 1\]",
    ),
    "material": (
        lambda b: primitive(b).update(material=2),
        "expected one of its 2 materials, got number 2",
    ),
    "vertices": (
        lambda b: primitive(b)["attributes"].update(TEXCOORD_0=0),
        "accessor 0: expected 24 elements of VEC2, got 24 of VEC3",
    ),
    "faces": (
        lambda b: b.document["accessors"][primitive(b)["attributes"]["POSITION"]].update(count=5),
        "expected faces with its 5 vertices, got others",
    ),
    "outside": (
        lambda b: b.document["bufferViews"][0].update(byteLength=10**6),
        "buffer view 0: expected 1000000 bytes from byte 0, got a buffer of",
    ),
    "elements": (
        lambda b: b.document["accessors"][0].update(byteOffset=100),
        "buffer view 0: expected 24 elements from byte 100, got 288 bytes",
    ),
    "nan": (
        lambda b: setattr(b, "data", np.float32(np.nan).tobytes() + b.data[4:]),
        "accessor 0: expected finite numbers of at most 1e\\+12, got others",
    ),
    "cycle": (lambda b: b.document["nodes"][2].update(children=[1]), "expected a hierarchy of nodes, got a cycle"),
    "parents": (lambda b: b.document["nodes"][0].update(children=[2]), "expected a node 2 with one parent"),
    "joints": (
        lambda b: b.document["skins"][0].update(joints=[1]),
        "node 0: expected vertices with joints of its skin, got none or too large ones",
    ),
    "times": (
        lambda b: b.document["animations"][0]["samplers"][0].update(output=b.array([0.0, 1.0])),
        "animation 'bend', rotation of node 2: expected ascending times with a value of 4 numbers each, got 2 times, 2",
    ),
    "claim": (
        lambda b: (
            b.document["accessors"].append({"count": 10**12, "type": "VEC3", "componentType": 5126})
            or primitive(b)["attributes"].update(POSITION=len(b.document["accessors"]) - 1)
        ),
        "a claim of an accessor of 1000000000000 elements",
    ),
    "shared accessor": (
        lambda b: b.document["meshes"][0].update(primitives=40 * [{"attributes": {"POSITION": zeros(b, 3_000_000)}}]),
        "got a claim of an accessor of 3000000 elements, with all before it",
    ),
    "shared target": (
        lambda b: primitive(b).update(targets=200 * [{"POSITION": 0}] + [{}] * 400_000),
        "got a claim of 400200 morph targets, with all before it",
    ),
    "shared mesh": (
        lambda b: (
            b.document["meshes"][2].update(primitives=[{"attributes": {"POSITION": zeros(b, 300_000)}}])
            or b.document["nodes"].extend(40 * [{"mesh": 2}])
        ),
        "got a claim of a mesh of a node, with all before it",
    ),
    "signed faces": (lambda b: primitive(b).update(indices=b.array([0, 1, -1], "i1")), "unsigned integers .* got int8"),
    "real faces": (lambda b: primitive(b).update(indices=b.array([0, 1, 1e30])), "unsigned integers .* got float32"),
    "normalized faces": (
        lambda b: primitive(b).update(indices=b.array([0, 1, 2], "u1", normalized=True)),
        "expected unsigned integers as indices",
    ),
    "signed joints": (
        lambda b: primitive(b)["attributes"].update(JOINTS_0=b.array(-column()["joints"], "i2")),
        "unsigned integers as indices, got int16",
    ),
    "signed places": (lambda b: sparse(b, "i1"), "accessor 0: expected unsigned integers as indices, got int8"),
    "real places": (lambda b: sparse(b, "f4"), "accessor 0: expected unsigned integers as indices, got float32"),
    "many nodes": (lambda b: b.document["nodes"].extend(5000 * [{}]), "expected at most 5000 nodes, got 5006"),
    "nan place": (
        lambda b: b.document["nodes"][1].update(translation=[0, float("nan"), 0]),
        "node 'hip': expected finite numbers of at most",
    ),
    "huge scale": (lambda b: b.document["nodes"][1].update(scale=[1e300, 1, 1]), "node 'hip': expected finite numbers"),
    "huge matrix": (lambda b: b.document["nodes"][1].update(matrix=[1e13] * 16), "node 'hip': expected finite numbers"),
    "nan color": (
        lambda b: b.document["materials"][1]["pbrMetallicRoughness"].update(metallicFactor=float("nan")),
        "material: expected finite numbers",
    ),
    "scene": (lambda b: b.document.update(scene=-1), "expected one of its 1 scenes, got number -1"),
    "root": (lambda b: b.document["scenes"][0].update(nodes=[9]), "expected one of its 6 nodes, got number 9"),
    "skin": (lambda b: b.document["nodes"][0].update(skin=-3), "expected one of its 1 skins, got number -3"),
    "mesh": (lambda b: b.document["nodes"][0].update(mesh=-1), "expected one of its 3 meshes, got number -1"),
    "joint": (lambda b: b.document["skins"][0].update(joints=[1, 6]), "expected one of its 6 nodes, got number 6"),
    "image": (lambda b: b.document["textures"][0].update(source=-1), "expected one of its 1 images, got number -1"),
    "half": (lambda b: primitive(b).update(indices=0.5), "expected one of its [0-9]+ accessors, got number 0.5"),
    "animated node": (
        lambda b: b.document["animations"][0]["channels"][0]["target"].update(node=9),
        "expected one of its 6 nodes, got number 9",
    ),
    "sampler": (
        lambda b: b.document["animations"][0]["channels"][0].update(sampler=-1),
        "animation 'bend': expected samplers of its own, got -1",
    ),
    "channels": (
        lambda b: b.document["animations"][0].update(channels=2 * b.document["animations"][0]["channels"]),
        "animation 'bend': expected one channel for a property of a node, got several",
    ),
    "missing key": (
        lambda b: b.document["meshes"][0].pop("primitives"),
        r"expected a glTF 2.0 file, got a broken one \(KeyError: 'primitives'\); export it again",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_read_gltf__refuses_a_wrong_file(tmp_path: Path, case: str) -> None:
    spoil, message = WRONG[case]
    b = model()
    spoil(b)
    path = write_glb(tmp_path / "model.glb", b)
    with pytest.raises(ValueError, match=f"^{path}: .*({message})"):
        read_gltf(path)


def test_read_gltf__names_missing_files(tmp_path: Path) -> None:
    path = write_gltf(tmp_path / "model.gltf", model())
    (tmp_path / "its data.bin").unlink()
    with pytest.raises(FileNotFoundError, match=f"^{path}: its file .*its data.bin does not exist; copy it there"):
        read_gltf(path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.glb: expected a glTF file, got none"):
        read_gltf(tmp_path / "nowhere.glb")


@pytest.mark.parametrize("uri", ["../secret.bin", "%2e%2e/secret.bin", "{}/secret.bin", "a/../../secret.bin", "link"])
def test_read_gltf__reads_no_file_outside_its_folder(tmp_path: Path, uri: str) -> None:
    folder, b = tmp_path / "model", model()
    (folder / "a").mkdir(parents=True)
    (tmp_path / "secret.bin").write_bytes(b.data)
    (folder / "link").symlink_to("../secret.bin")
    b.document["buffers"] = [{"byteLength": len(b.data), "uri": uri.format(tmp_path)}]
    path = folder / "model.gltf"
    path.write_text(json.dumps(b.document))
    with pytest.raises(ValueError, match=f"^{path}: expected files in its folder, got .*{uri[-4:]}; copy it there"):
        read_gltf(path)


def test_read_gltf__counts_the_files_that_it_names(tmp_path: Path) -> None:
    """A text of 2 kB with 30 MB beside it may hold as much as one file of 30 MB."""
    b = model()
    many = b.array(np.zeros((2_500_000, 3)))
    b.document["meshes"][2]["primitives"] = 2 * [{"attributes": {"POSITION": many}, "indices": primitive(b)["indices"]}]
    found = read_gltf(write_gltf(tmp_path / "model.gltf", b))
    assert [len(part.positions) for part in found.meshes[2]] == 2 * [2_500_000]


def test_read_gltf__refuses_damaged_files_with_one_sentence(tmp_path: Path) -> None:
    whole, rng, path = glb_bytes(model()), np.random.default_rng(0), tmp_path / "model.glb"
    end = whole.index(b"BIN\0")
    messages = []
    for case in range(200):
        damaged = bytearray(whole)
        if case % 2:
            damaged = damaged[: rng.integers(len(whole))]
        else:
            damaged[rng.integers(12, end)] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_gltf(path)
        except (ValueError, FileNotFoundError) as error:
            messages.append(str(error))
    assert len(messages) > 100
    assert all(message.startswith(f"{path}: ") and message.count(str(path)) <= 2 for message in messages)

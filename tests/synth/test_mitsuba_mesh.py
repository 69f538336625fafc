"""Meshes for Mitsuba 3.9, which is installed, and for 3.10, whose interface a stand-in has."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.synth import mitsuba_mesh
from morgs_mi.synth.scene import Deformed, Mesh

VERTICES = np.arange(15.0).reshape(5, 3)
TRIANGLES = Mesh(np.array([[4, 1, 3], [1, 3, 0]]), {}, np.linspace(0, 1, 10).reshape(5, 2), smooth=True)
USED = np.array([0, 1, 3, 4])


class _Mesh310:
    """Constructor of Mitsuba 3.10 (its release notes, "Redesigned mesh representation")."""

    from_fields = None

    def __init__(self, name: str, face_normals: bool, **arrays: Any) -> None:
        self.name, self.face_normals, self.bsdf, self.arrays = name, face_normals, None, arrays

    def set_bsdf(self, bsdf: Any) -> None:
        self.bsdf = bsdf


def test_new_mesh__has_the_used_vertices_alone():
    made = mitsuba_mesh.new_mesh("part", mi.load_dict({"type": "diffuse"}), TRIANGLES, USED, VERTICES)
    found = mi.traverse(made)
    np.testing.assert_array_equal(found["faces"], [3, 1, 2, 1, 2, 0])
    np.testing.assert_array_equal(found["vertex_positions"], VERTICES[USED].ravel())
    assert TRIANGLES.uvs is not None
    np.testing.assert_array_equal(found["vertex_texcoords"], np.float32(TRIANGLES.uvs[USED].ravel()))


def test_new_mesh__gives_mitsuba_3_10_all_data_at_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(mi, "Mesh", _Mesh310)
    made = mitsuba_mesh.new_mesh("part", "material", TRIANGLES, USED, VERTICES)
    assert (made.name, made.face_normals, made.bsdf) == ("part", False, "material")
    np.testing.assert_array_equal(made.arrays["faces"], [[3, 1, 2], [1, 2, 0]])
    np.testing.assert_array_equal(made.arrays["positions"], VERTICES[USED])
    assert TRIANGLES.uvs is not None
    np.testing.assert_array_equal(made.arrays["texcoords"], np.float32(TRIANGLES.uvs[USED]))


@pytest.mark.parametrize("smooth", [False, True])
def test_move_mesh__writes_the_parameters_of_both_versions(smooth: bool):
    shape = Deformed(VERTICES, VERTICES[::-1])
    old: dict[str, Any] = {"part.vertex_positions": None}
    new: dict[str, Any] = {"part.positions": None}
    for params in (old, new):
        mitsuba_mesh.move_mesh(params, "part", USED, smooth, shape)
    assert set(old) == {"part.vertex_positions"} | ({"part.vertex_normals"} if smooth else set())
    for key, values in new.items():
        assert values.shape == (4, 3)
        np.testing.assert_array_equal(np.ravel(values), old[key.replace(".", ".vertex_")])

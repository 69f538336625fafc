"""Animated models against slow float64 computations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morgs_mi.io.gltf import Channel, Gltf, read_gltf
from morgs_mi.synth.animation import deform, pose_at, sample
from tests.assertions import assert_close
from tests.scenes.animated_gltf import BENDING, write_glb


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Gltf:
    return read_gltf(write_glb(tmp_path_factory.mktemp("gltf") / "model.glb"))


def channel(values: np.ndarray, interpolation: str, path: str = "translation") -> Channel:
    return Channel(0, path, np.array([0.5, 1.0, 3.0]), np.asarray(values, float), interpolation)


def test_sample__linear_and_step_keys() -> None:
    values = np.array([(0, 0, 0), (1, 2, 3), (3, 2, 1)])
    linear, step = channel(values, "LINEAR"), channel(values, "STEP")
    assert_close(sample(linear, 0.75), [0.5, 1, 1.5], atol=1e-12)
    assert_close(sample(linear, 2.0), [2, 2, 2], atol=1e-12)
    assert sample(step, 0.99).tolist() == [0, 0, 0]
    assert sample(step, 1.0).tolist() == [1, 2, 3]
    for keys in (linear, step):
        assert sample(keys, -5).tolist() == [0, 0, 0]
        assert sample(keys, 9).tolist() == [3, 2, 1]


def test_sample__cubic_splines_have_the_values_and_slopes_of_their_keys() -> None:
    values = np.random.default_rng(0).normal(size=(3, 3, 2))
    spline = channel(values, "CUBICSPLINE")
    for i, time in enumerate((0.5, 1.0, 3.0)):
        assert_close(sample(spline, time), values[i, 1], atol=1e-12)
    for time, slope, side in ((0.5, values[0, 2], 1), (1.0, values[1, 0], -1), (1.0, values[1, 2], 1)):
        step = 1e-6 * side
        assert_close((sample(spline, time + step) - sample(spline, time)) / step, slope, atol=1e-4)


def test_sample__rotations_turn_evenly_the_short_way() -> None:
    turns = [Rotation.from_rotvec((0, 0, angle)).as_quat() for angle in (0.0, 1.0, 1.5)]
    keys = channel(np.array([turns[0], -turns[1], turns[2]]), "LINEAR", "rotation")
    for time, angle in ((0.625, 0.25), (0.875, 0.75), (2.0, 1.25)):
        assert_close(Rotation.from_quat(sample(keys, time)).as_rotvec(), [0, 0, angle], atol=1e-9)


def test_deform__blends_the_matrices_of_the_joints(model: Gltf) -> None:
    """A vertex between two joints is the weighted mean of where each of them takes it."""
    time = 0.6
    found = deform(model, 0, pose_at(model, model.animations[0], time), np.eye(4)).vertices
    knee = np.array([0, 1, 0])
    bend = Rotation.from_rotvec((0, 0, BENDING * time))
    rest, weights = model.meshes[0][0].positions, model.meshes[0][0].weights
    assert weights is not None
    expected = weights[:, :1] * rest + weights[:, 1:2] * (bend.apply(rest - knee) + knee)
    assert_close(found, expected, atol=1e-6)
    assert np.abs(found - rest).max() > 0.3, "it bends, without the translation of its node"


def test_deform__moves_morph_targets_and_nodes(model: Gltf) -> None:
    posed = pose_at(model, model.animations[0], 0.25)
    stand, tile = np.array([1, 1.5, 1]), model.meshes[1][0]
    expected = stand * (tile.positions + 0.25 * tile.targets[0]) + [-1.5, 0, 0.5]
    assert_close(deform(model, 4, posed, np.eye(4)).vertices, expected, atol=1e-6)
    late = pose_at(model, model.animations[0], 1.0)
    expected = model.meshes[2][0].positions * [1, 1.5, 1] + [1.5, 0.5, 0]
    assert_close(deform(model, 5, late, np.eye(4)).vertices, expected, atol=1e-6)
    still = pose_at(model, model.animations[1], 0.5)
    assert_close(deform(model, 5, still, np.eye(4)).vertices, model.meshes[2][0].positions, atol=0)


@pytest.mark.parametrize("stretch", [(1, 1, 1), (2, 0.5, 1), (-1, 1, 3)])
def test_deform__normals_stay_perpendicular_to_their_faces(model: Gltf, stretch: tuple[float, ...]) -> None:
    """A rigid turn of both joints, then a stretch, which does not act on normals as on points."""
    still = replace(model.animations[0], channels=())
    to_world = np.diag([*stretch, 1.0])
    to_world[:3, :3] = to_world[:3, :3] @ Rotation.from_rotvec((0.3, -0.5, 0.7)).as_matrix()
    found, faces = deform(model, 0, pose_at(model, still, 0), to_world), model.meshes[0][0].faces
    a, b, c = found.vertices[faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    across *= np.sign(np.prod(stretch)) / np.linalg.norm(across, axis=1, keepdims=True)
    assert found.normals is not None
    own = model.meshes[0][0].normals
    assert own is not None
    a, b, c = model.meshes[0][0].positions[faces].transpose(1, 0, 2)
    outward = np.sign((np.cross(b - a, c - a) * own[faces[:, 0]]).sum(axis=1))
    assert_close(found.normals[faces[:, 0]], outward[:, None] * across, atol=1e-6)

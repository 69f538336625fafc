"""Animated glTF models as deforming vertices: node hierarchies, morph targets and linear-blend skinning.

With W_n the matrix of node n to the world, B_j the inverse bind matrix of joint j and w_j its weight at a vertex, a
skinned vertex is at sum_j w_j W_j B_j x, and any other vertex at W_n x. Morph targets are added to x.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.io.gltf import Animation, Channel, Gltf, Node, Primitive
from morgs_mi.synth.scene import Deformed

__all__ = ["Posed", "deform", "pose_at", "sample"]


@dataclass(frozen=True)
class Posed:
    """The nodes of a model at one time.

    Attributes:
        matrices: transform from each node to the world [N, 4, 4].
        weights: weights of each node's morph targets.
    """

    matrices: np.ndarray
    weights: tuple[np.ndarray, ...]


def sample(channel: Channel, time: float) -> np.ndarray:
    """Return the animated value [D] at `time` in seconds; before the first key and after the last it is constant."""
    times, values = channel.times, channel.values
    time = float(np.clip(time, times[0], times[-1]))
    i = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 1))
    j = min(i + 1, len(times) - 1)
    step = times[j] - times[i]
    u = (time - times[i]) / step if step > 0 else 0.0
    if channel.interpolation == "CUBICSPLINE":
        (_, here, leaving), (arriving, there, _) = values[i], values[j]
        value = (2 * u**3 - 3 * u**2 + 1) * here + step * (u**3 - 2 * u**2 + u) * leaving
        return value + (3 * u**2 - 2 * u**3) * there + step * (u**3 - u**2) * arriving
    if channel.interpolation == "STEP" or i == j:
        return values[i]
    if channel.path == "rotation":
        first, second = Rotation.from_quat(values[i]), Rotation.from_quat(values[j])
        # The rotation vector of the difference takes the shorter way.
        return (first * Rotation.from_rotvec(u * (first.inv() * second).as_rotvec())).as_quat()
    return (1 - u) * values[i] + u * values[j]


def pose_at(model: Gltf, animation: Animation, time: float) -> Posed:
    """Return the nodes of a model at `time` in seconds of an animation."""
    moved: dict[int, dict[str, np.ndarray]] = {}
    for channel in animation.channels:
        moved.setdefault(channel.node, {})[channel.path] = sample(channel, time)
    matrices = _at_rest(model).copy()
    for index in moved:
        matrices[index] = _local(model.nodes[index], moved[index])
    for index in model.order:
        if (parent := model.nodes[index].parent) >= 0:
            matrices[index] = matrices[parent] @ matrices[index]
    weights = (moved.get(index, {}).get("weights", node.weights) for index, node in enumerate(model.nodes))
    return Posed(matrices, tuple(weights))


@lru_cache(maxsize=4)
def _at_rest(model: Gltf) -> np.ndarray:
    """Return the matrices [N, 4, 4] of the nodes to their parents, without animation."""
    return np.array([_local(node, {}) for node in model.nodes]).reshape(-1, 4, 4)


def _local(node: Node, moved: dict[str, np.ndarray]) -> np.ndarray:
    """Return the matrix [4, 4] of a node to its parent, with the values that an animation replaces."""
    if node.matrix is not None:
        return node.matrix
    matrix = np.eye(4)
    rotation = Rotation.from_quat(moved.get("rotation", node.rotation)).as_matrix()
    matrix[:3, :3] = rotation * moved.get("scale", node.scale)
    matrix[:3, 3] = moved.get("translation", node.translation)
    return matrix


def deform(model: Gltf, index: int, posed: Posed, to_world: np.ndarray) -> Deformed:
    """Return the concatenated vertices of a node's primitives, with normals if any primitive has them.

    Args:
        model: the model.
        index: index of the node.
        posed: nodes of the model at the time.
        to_world: transform from the model to the world [4, 4].
    """
    node = model.nodes[index]
    primitives = model.meshes[node.mesh]
    vertices, normals = [], []
    for primitive in primitives:
        points, directions = _morphed(primitive, posed.weights[index])
        matrices = to_world @ _vertex_matrices(model, node, primitive, posed, index)
        linear = matrices[:, :3, :3]
        vertices.append(np.einsum("vij,vj->vi", linear, points) + matrices[:, :3, 3])
        normals.append(_unit(np.einsum("vji,vj->vi", _inverses(linear), directions)))
    smooth = any(primitive.normals is not None for primitive in primitives)
    return Deformed(np.concatenate(vertices), np.concatenate(normals) if smooth else None)


def _morphed(primitive: Primitive, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions and normals [V, 3] with the morph targets; the normals of a flat primitive are zero."""
    positions = primitive.positions + np.tensordot(weights, primitive.targets, axes=1)
    if primitive.normals is None:
        return positions, np.zeros_like(positions)
    return positions, primitive.normals + np.tensordot(weights, primitive.normal_targets, axes=1)


def _vertex_matrices(model: Gltf, node: Node, primitive: Primitive, posed: Posed, index: int) -> np.ndarray:
    """Return the matrix to the model's space of every vertex [V, 4, 4], or of all [1, 4, 4]."""
    if node.skin < 0 or primitive.joints is None or primitive.weights is None:
        return posed.matrices[index][None]
    skin = model.skins[node.skin]
    joints = posed.matrices[skin.joints] @ skin.inverse_bind
    # One set of weights after the other, because [V, J, 4, 4] takes much memory.
    matrices = np.zeros((len(primitive.positions), 4, 4))
    for weight, joint in zip(primitive.weights.T, primitive.joints.T, strict=True):
        matrices += weight[:, None, None] * joints[joint]
    return matrices


def _inverses(matrices: np.ndarray) -> np.ndarray:
    """Return the adjugates [V, 3, 3]: the inverses up to a factor, which also exist for flattened parts."""
    a, b, c = np.swapaxes(matrices, 1, 2).swapaxes(0, 1)
    rows = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    # The factor is the determinant. Its sign matters.
    return rows * np.where(np.linalg.det(matrices) < 0, -1, 1)[:, None, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return unit vectors [V, 3]; a vector of zeros becomes y."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(lengths > 0, vectors / np.where(lengths > 0, lengths, 1), (0, 1, 0))

"""An animated glTF model in the room of the synthetic scenes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.core.color_space import srgb_to_linear
from morgs_mi.io.gltf import Animation, Gltf, Material, Primitive, Texture, read_gltf
from morgs_mi.synth.animation import Posed, deform, pose_at
from morgs_mi.synth.scene import Deformed, DeformingObject, Mesh, Rig, Scene, rotate, translate
from morgs_mi.synth.textures import lights, room

__all__ = ["gltf_scene"]

# The largest box of a model in the room [3], world units, and its centre on the floor.
_BOX = np.array([2.8, 1.7, 2.4])
_CENTER = np.array([0.0, 0.0, 0.2])
# glTF's models face +z, towards the cameras. The side view shows more of a walk.
_TURN = np.deg2rad(40.0)
# Times at which the box of an animated model is measured.
_NUM_TIMES = 48


def gltf_scene(path: str | Path, animation: str | None = None, seed: int = 0) -> Scene:
    """Return a scene with an animated glTF model, scaled to the room and standing on its floor.

    Skinning, morph targets, moving nodes, and base colours, roughness and metalness with textures are supported.
    The animation is repeated. Each node with a mesh is an object. Transparent materials are opaque.

    Args:
        path: a .glb or .gltf file.
        animation: name of the animation; None for the first.
        seed: seed of the room's textures.

    Raises:
        FileNotFoundError: the file, or one that it names, does not exist.
        ValueError: the file is broken, or it has no mesh, no animation, or no animation named `animation`.
    """
    path = Path(path)
    model = read_gltf(path)
    drawn = [i for i, node in enumerate(model.nodes) if node.drawn and node.mesh >= 0]
    if not drawn:
        raise ValueError(f"{path}: expected a mesh in the scene, got none; export the objects with the animation.")
    played = _chosen(path, model, animation)

    @lru_cache(maxsize=4)
    def posed(time: float) -> Posed:
        return pose_at(model, played, time % played.duration if played.duration else 0.0)

    placed = _placement(path, model, drawn, posed, played.duration)
    materials = [_material(material) for material in model.materials]
    walls, lamps = room(seed), lights()
    names = _names([model.nodes[i].name for i in drawn], {*walls, *lamps})
    objects = {name: _object(model, index, posed, placed, materials) for name, index in zip(names, drawn, strict=True)}
    return Scene(path.stem, walls | objects, lamps, Rig(center=(0, 0.75, 0.2), distance=4.2))


def _chosen(path: Path, model: Gltf, name: str | None) -> Animation:
    """Return the animation with this name, or the first one."""
    if not model.animations:
        raise ValueError(f"{path}: expected an animation, got none; export the model with its animation.")
    if name is None:
        return model.animations[0]
    for animation in model.animations:
        if animation.name == name:
            return animation
    known = ", ".join(repr(animation.name) for animation in model.animations)
    raise ValueError(f"gltf_scene(): `animation` must be one of {known} of {path}, got {name!r}; choose one of them.")


def _placement(
    path: Path, model: Gltf, drawn: list[int], posed: Callable[[float], Posed], duration: float
) -> np.ndarray:
    """Return the matrix [4, 4] that scales a model to the room and puts its swept box on the floor."""
    turned = rotate("y", _TURN)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    with np.errstate(over="ignore", invalid="ignore"):  # products of many scales, which are rejected below
        for time in np.linspace(0, duration, _NUM_TIMES, endpoint=False):
            points = np.concatenate([deform(model, i, posed(float(time)), turned).vertices for i in drawn])
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    size = high - low
    if not np.isfinite(size).all() or not size.max() > 0:
        raise ValueError(f"{path}: expected a model with an extent, got the size {size.tolist()}; export it again.")
    scale = (_BOX / np.maximum(size, 1e-6 * size.max())).min()
    foot = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    return translate(*_CENTER) @ np.diag([scale, scale, scale, 1]) @ translate(*-foot) @ turned


def _object(
    model: Gltf, index: int, posed: Callable[[float], Posed], placed: np.ndarray, materials: list[dict[str, Any]]
) -> DeformingObject:
    """Return the object of a node, with one mesh per primitive."""
    primitives = model.meshes[model.nodes[index].mesh]
    counts = [len(primitive.positions) for primitive in primitives]
    uvs = np.concatenate([np.zeros((len(p.positions), 2)) if p.uvs is None else p.uvs for p in primitives])
    starts = np.cumsum([0, *counts])
    meshes = {f"mesh{i}": _mesh(p, int(starts[i]), uvs, materials) for i, p in enumerate(primitives)}

    # The ground truth of a frame uses the vertices of the frame and of its neighbours several times.
    @lru_cache(maxsize=4)
    def shape(time: float) -> Deformed:
        return deform(model, index, posed(time), placed)

    return DeformingObject(meshes, shape)


def _mesh(primitive: Primitive, start: int, uvs: np.ndarray, materials: list[dict[str, Any]]) -> Mesh:
    bsdf = materials[primitive.material] if primitive.material >= 0 else _material(Material())
    return Mesh(start + primitive.faces, bsdf, uvs, primitive.normals is not None)


def _material(material: Material) -> dict[str, Any]:
    """Return a material as Mitsuba's `principled`, seen from both sides."""
    color, surface = material.color_texture, material.surface_texture
    base: dict[str, Any] = {"type": "rgb", "value": list(material.color)}
    if color is not None:
        base = _bitmap(color, np.array(material.color, np.float32) * srgb_to_linear(color.image / np.float32(255)))
    roughness, metallic = material.roughness, material.metallic
    entries: dict[str, Any] = {"roughness": max(roughness, 0.03), "metallic": metallic}
    if surface is not None:
        green, blue = surface.image[..., 1:2] / np.float32(255), surface.image[..., 2:3] / np.float32(255)
        entries = {"roughness": _bitmap(surface, np.maximum(roughness * green, 0.03))}
        entries["metallic"] = _bitmap(surface, metallic * blue)
    return {"type": "twosided", "bsdf": {"type": "principled", "base_color": base, **entries}}


def _bitmap(texture: Texture, values: np.ndarray) -> dict[str, Any]:
    import mitsuba as mi

    bitmap = mi.Bitmap(np.ascontiguousarray(values, np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": texture.wrap}


def _names(names: Iterable[str], taken: set[str]) -> list[str]:
    """Return names that differ from one another and from `taken`, without characters that Mitsuba rejects."""
    found: list[str] = []
    counts: dict[str, int] = {}
    for name in names:
        base = re.sub(r"[^\w-]", "_", name) or "node"
        name = base
        while name in taken:
            counts[base] = counts.get(base, 1) + 1
            name = f"{base}_{counts[base]}"
        taken.add(name)
        found.append(name)
    return found

"""Meshes of Mitsuba with moving vertices.

Mitsuba 3.10 takes the data of a mesh at once, and gives its parameters other names and shapes: `positions` [V, 3] in
place of `vertex_positions` [3V]. Both versions are served.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from morgs_mi.synth.scene import Deformed, Mesh

__all__ = ["move_mesh", "new_mesh"]


def new_mesh(name: str, bsdf: Any, mesh: Mesh, used: np.ndarray, vertices: np.ndarray) -> Any:
    """Return a Mitsuba mesh.

    Args:
        name: its name in the scene.
        bsdf: its material, a Mitsuba object.
        mesh: its triangles.
        used: sorted indices of the vertices in these triangles [U].
        vertices: positions of all vertices of the object [V, 3].
    """
    kind: Any = mi.Mesh
    faces, uvs = np.searchsorted(used, mesh.faces), None if mesh.uvs is None else mesh.uvs[used]
    if hasattr(mi.Mesh, "from_fields"):  # Mitsuba 3.10
        tensor: Any = mi.TensorXu
        given = {"faces": tensor(faces), "positions": mi.TensorXf(vertices[used])}
        given |= {} if uvs is None else {"texcoords": mi.TensorXf(uvs)}
        made = kind(name, **given, face_normals=not mesh.smooth)
        made.set_bsdf(bsdf)
        return made
    props = mi.Properties()
    props["bsdf"], props["face_normals"] = bsdf, not mesh.smooth
    made = kind(name, len(used), len(faces), props, mesh.smooth, uvs is not None)
    params: Any = mi.traverse(made)
    params["faces"] = mi.UInt32(faces.ravel())
    params["vertex_positions"] = mi.Float(vertices[used].ravel())
    if uvs is not None:
        params["vertex_texcoords"] = mi.Float(uvs.ravel())
    params.update()
    return made


def move_mesh(params: Any, name: str, used: np.ndarray, smooth: bool, shape: Deformed) -> None:
    """Set the vertices of a mesh in a scene, and its normals if it is smooth and they are known.

    Args:
        params: parameters of the scene; their `update` is left to the caller.
        name: name of the mesh.
        used: indices of its vertices in the object [U].
        smooth: whether it is shaded with normals of the vertices.
        shape: vertices of the object.
    """
    given = {"positions": shape.vertices}
    if smooth and shape.normals is not None:
        given["normals"] = shape.normals
    for key, values in given.items():
        if f"{name}.positions" in params:  # Mitsuba 3.10
            params[f"{name}.{key}"] = mi.TensorXf(values[used])
        else:
            params[f"{name}.vertex_{key}"] = mi.Float(values[used].ravel())

"""A small animated glTF model: a skinned column that bends, a morphing tile, and a box on a moving node."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

__all__ = ["Builder", "glb_bytes", "model", "write_glb", "write_gltf"]

_TYPES = {"f4": 5126, "u1": 5121, "u2": 5123, "i1": 5120, "i2": 5122, "u4": 5125}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
# Upper left, upper right, lower left, lower right; RGB.
COLORS = np.array([[(220, 40, 40), (40, 220, 40)], [(40, 40, 220), (220, 220, 40)]], np.uint8)
BENDING = 0.9


class Builder:
    """A glTF document and its buffer, to which arrays are appended."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}
        self.data = b""

    def view(self, data: bytes, **entries: Any) -> int:
        """Append bytes; return the index of their buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **entries}
        self.document["bufferViews"].append(view)
        self.data += data
        return len(self.document["bufferViews"]) - 1

    def array(self, values: Any, dtype: str = "f4", **entries: Any) -> int:
        """Append an array [N, ...]; return the index of its accessor."""
        values = np.asarray(values).astype(f"<{dtype}" if dtype[1] != "1" else dtype)
        values = values.reshape(len(values), -1)
        accessor = {"componentType": _TYPES[dtype], "count": len(values), "type": _KINDS[values.shape[1]], **entries}
        self.document["accessors"].append({"bufferView": self.view(values.tobytes()), **accessor})
        return len(self.document["accessors"]) - 1


def column() -> dict[str, np.ndarray]:
    """Return a square column of height 2 with rings at y = 0, 1 and 2; the second joint holds its upper half."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 0.4
    sides = []
    for i in range(4):
        (x0, z0), (x1, z1) = corners[i], corners[(i + 1) % 4]
        sides += [[(x0, y, z0), (x1, y, z1)] for y in (0, 1, 2)]
    positions = np.array(sides, float).reshape(-1, 3)  # 4 sides of 3 rings of 2
    quads = [(6 * s + 2 * r) + np.array([0, 2, 1, 1, 2, 3]) for s in range(4) for r in range(2)]
    upper = positions[:, 1] / 2
    zero = np.zeros(len(positions))
    return {
        "positions": positions,
        "faces": np.concatenate(quads),
        "uvs": np.stack([np.tile([0.0, 1.0], 12), 1 - upper], axis=1),
        "normals": np.repeat([(0, 0, -1), (1, 0, 0), (0, 0, 1), (-1, 0, 0)], 6, axis=0).astype(float),
        "joints": np.stack([zero, zero + 1, zero, zero], axis=1),
        "weights": np.stack([1 - upper, upper, zero, zero], axis=1),
    }


def model() -> Builder:
    """Return a model with the animations ``bend`` (all kinds of samplers, one second) and ``rest``."""
    b, c = Builder(), column()
    png = cv2.imencode(".png", cv2.cvtColor(np.kron(COLORS, np.ones((8, 8, 1), np.uint8)), cv2.COLOR_RGB2BGR))[1]
    attributes = {
        "POSITION": b.array(c["positions"]),
        "NORMAL": b.array(c["normals"]),
        "TEXCOORD_0": b.array(c["uvs"]),
        "JOINTS_0": b.array(c["joints"], "u1"),
        "WEIGHTS_0": b.array(c["weights"]),
    }
    skinned = {"attributes": attributes, "indices": b.array(c["faces"], "u2"), "material": 0}
    tile = np.array([(-0.5, 0, 0), (0.5, 0, 0), (-0.5, 1, 0), (0.5, 1, 0)])
    bulge = np.array([(0, 0, 0), (0, 0, 0), (0, 0.4, 0.5), (0, 0, 0)])
    quad = b.array([0, 1, 2, 1, 3, 2], "u2")
    morphing = {
        "attributes": {"POSITION": b.array(tile), "TEXCOORD_0": b.array((tile[:, :2] + (0.5, 0)) * (1, -1) + (0, 1))},
        "indices": quad,
        "material": 0,
        "targets": [{"POSITION": b.array(bulge)}],
    }
    plain = {"attributes": {"POSITION": b.array(tile)}, "indices": quad, "material": 1}
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 1, 3] = -1  # the second joint is at y = 1
    half = BENDING / 2
    keys, rotations = b.array([0.0, 1.0]), b.array([(0, 0, 0, 1), (0, 0, np.sin(half), np.cos(half))])
    spline = [[(0, 0, 0), (1.5, 0, 0), (1, 0, 0)], [(0, 0, 1), (1.5, 0.5, 0), (0, 0, 0)]]
    samplers = [
        {"input": keys, "output": rotations},
        {"input": keys, "output": b.array([0.0, 1.0])},
        {"input": keys, "output": b.array(np.reshape(spline, (6, 3))), "interpolation": "CUBICSPLINE"},
        {"input": b.array([0.0, 0.5]), "output": b.array([(1, 1, 1), (1, 1.5, 1)]), "interpolation": "STEP"},
    ]
    targets = [(2, "rotation"), (4, "weights"), (5, "translation"), (5, "scale")]
    channels = [{"sampler": i, "target": {"node": n, "path": path}} for i, (n, path) in enumerate(targets)]
    b.document |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 3, 5]}],
        "nodes": [
            {"name": "column", "mesh": 0, "skin": 0, "translation": [9, 9, 9]},  # without effect: it is skinned
            {"name": "hip", "children": [2]},
            {"name": "knee", "translation": [0, 1, 0]},
            {"name": "stand", "translation": [-1.5, 0, 0.5], "scale": [1, 1.5, 1], "children": [4]},
            {"name": "tile", "mesh": 1},
            {"name": "floor", "mesh": 2},
        ],
        "meshes": [{"primitives": [skinned]}, {"primitives": [morphing], "weights": [0.5]}, {"primitives": [plain]}],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": b.array(inverse.transpose(0, 2, 1))}],
        "images": [{"bufferView": b.view(png.tobytes()), "mimeType": "image/png"}],
        "samplers": [{"wrapS": 33071}],
        "textures": [{"source": 0, "sampler": 0}],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 0.9}},
            {"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1], "metallicFactor": 0}},
        ],
        "animations": [
            {"name": "bend", "samplers": samplers, "channels": channels},
            {"name": "rest", "samplers": samplers[:1], "channels": [{"sampler": 0, "target": {"path": "rotation"}}]},
        ],
    }
    return b


def glb_bytes(b: Builder) -> bytes:
    """Return the bytes of a .glb file."""
    document = json.dumps({**b.document, "buffers": [{"byteLength": len(b.data)}]}).encode()
    document += b" " * (-len(document) % 4)
    data = b.data + b"\0" * (-len(b.data) % 4)
    chunks = ((b"JSON", document), (b"BIN\0", data))
    body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def write_glb(path: Path, b: Builder | None = None) -> Path:
    """Write a .glb file, of `model` by default; return its path."""
    path.write_bytes(glb_bytes(b or model()))
    return path


def write_gltf(path: Path, b: Builder, embedded: bool = False) -> Path:
    """Write a .gltf file with its buffer as a data URI or beside it; return its path."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(b.data).decode() if embedded else "its%20data.bin"
    if not embedded:
        (path.parent / "its data.bin").write_bytes(b.data)
    buffer = {"byteLength": len(b.data), "uri": uri}
    path.write_text(json.dumps({**b.document, "buffers": [buffer]}))
    return path

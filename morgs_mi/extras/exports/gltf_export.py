"""Gaussians as a binary glTF 2.0 file with the extension `KHR_gaussian_splatting`.

A .glb file consists of a header, a JSON chunk and a binary chunk. The Gaussians are one point
primitive. Each attribute has its own accessor and buffer view, little-endian float32:

    POSITION                                        VEC3    centre
    KHR_gaussian_splatting:ROTATION                 VEC4    unit quaternion, xyzw
    KHR_gaussian_splatting:SCALE                    VEC3    standard deviations
    KHR_gaussian_splatting:OPACITY                  SCALAR  0 to 1
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n       VEC3    RGB coefficient, degree l, order n - l
    COLOR_0                                         VEC4    linear RGB and opacity, for viewers that
                                                            draw points

glTF's axes have y up. Centres, rotations and spherical harmonics are rotated rather than the node:
a viewer does not have to rotate the harmonics.

The extension has two colour spaces, sRGB and linear light. Colours above white are encoded by a
curve that it does not have (see `color_space`), so they are written as linear light: the mean
colour of a Gaussian exactly, what depends on the direction to first order. Viewers then blend
linear light, where this package blends encoded colours.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from morgs_mi.core.camera import Camera, unit_vectors
from morgs_mi.core.color_space import SH_C0, decode_light
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import rotated, unit_quats
from morgs_mi.core.rig import up_direction
from morgs_mi.core.types import Arrays
from morgs_mi.platform.checks import require
from morgs_mi.platform.files import atomic_path

_NAME = "KHR_gaussian_splatting"
SRGB = "srgb_rec709_display"
"""The extension's name of encoded colours."""
LINEAR = "lin_rec709_display"
"""The extension's name of linear light."""
_FLOAT = 5126
_ARRAY_BUFFER = 34962
_POINTS = 0
_STEP = 1e-4  # of a derivative, in encoded values
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf(
    path: str | Path, gaussians: Gaussians, axes: np.ndarray, color_space: str = SRGB
) -> None:
    """Write Gaussians as a self-contained .glb file; the file is written atomically.

    The extension has no attributes for motion and confidence, which are not written.

    Args:
        path: the file.
        gaussians: N Gaussians in world axes.
        axes: rotation [3, 3] from world axes to glTF's, see `gltf_axes`.
        color_space: `SRGB`, or `LINEAR` for the Gaussians of a recording in linear light.

    Raises:
        ValueError: there is no Gaussian, or there are more than fit into the 4 GiB of a .glb file.
        OSError: the file cannot be written.
    """
    data = glb(gaussians, axes, color_space)
    with atomic_path(path, "write_gltf()") as partial:
        partial.write_bytes(data)


def glb(gaussians: Gaussians, axes: np.ndarray, color_space: str = SRGB) -> bytes:
    """Return the bytes of the file that `write_gltf` writes.

    Raises:
        ValueError: as for `write_gltf`.
    """
    # An accessor must have at least one element.
    remedy = "glTF cannot hold an empty set"
    require(len(gaussians), "write_gltf()", "at least one Gaussian was expected", "none", remedy)
    if color_space == LINEAR:
        gaussians = _in_linear_light(gaussians)
    columns = _attributes(rotated(gaussians, axes), color_space)
    binary = b"".join(column.tobytes() for column in columns.values())
    # Rotation back to the capture's axes: x_world = M x_gltf.
    back = {"world_from_gltf": np.asarray(axes, float).T.tolist()}
    accessors = [
        {
            "bufferView": i,
            "componentType": _FLOAT,
            "count": len(column),
            "type": _TYPES[column.shape[1]],
        }
        for i, column in enumerate(columns.values())
    ]
    means = columns["POSITION"]
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    sizes = [column.nbytes for column in columns.values()]
    starts = np.cumsum([0, *sizes])
    splats = {
        "kernel": "ellipse",
        "colorSpace": color_space,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "mode": _POINTS,
        "attributes": {name: i for i, name in enumerate(columns)},
        "extensions": {_NAME: splats},
    }
    content = {
        "asset": {"version": "2.0", "generator": "morgs_mi"},
        "extensionsUsed": [_NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "extras": back}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": size, "target": _ARRAY_BUFFER}
            for start, size in zip(starts[:-1], sizes, strict=True)
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    document = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    document += b" " * (-len(document) % 4)
    size = 12 + 8 + len(document) + 8 + len(binary)
    require(
        size < 2**32,
        "write_gltf()",
        "expected less than 2^32 bytes",
        f"{size} of {len(gaussians)} Gaussians",
        "use PLY",
    )
    chunks = (
        struct.pack("<I4s", len(data), kind) + data
        for kind, data in ((b"JSON", document), (b"BIN\0", binary))
    )
    return struct.pack("<4sII", b"glTF", 2, size) + b"".join(chunks)


def _in_linear_light(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians whose colours are linear light: the mean over all directions exactly, the
    rest by the slope of the curve there.
    """
    mean = 0.5 + SH_C0 * gaussians.numpy()["sh_coeffs"][:, :1].astype(np.float64)
    slope = (decode_light(mean + _STEP) - decode_light(mean - _STEP)) / (2 * _STEP)
    coefficients = slope * gaussians.numpy()["sh_coeffs"]
    coefficients[:, :1] = (decode_light(mean) - 0.5) / SH_C0
    return replace(gaussians, sh_coeffs=coefficients.astype(np.float32))


def _attributes(gaussians: Gaussians, color_space: str) -> Arrays:
    raw = gaussians.numpy()
    alpha = np.clip(np.asarray(gaussians.opacities, np.float32), 0, 1)[:, None]
    coefficients = raw["sh_coeffs"]
    color = np.clip(0.5 + SH_C0 * coefficients[:, 0], 0, 1)
    if color_space == SRGB:
        color = decode_light(color)
    columns = {
        "POSITION": raw["means"],
        f"{_NAME}:ROTATION": np.roll(unit_quats(gaussians), -1, axis=1),
        f"{_NAME}:SCALE": np.exp(raw["log_scales"]),
        f"{_NAME}:OPACITY": alpha,
        **{
            f"{_NAME}:SH_DEGREE_{degree}_COEF_{n}": coefficients[:, degree * degree + n]
            for degree in range(gaussians.sh_degree + 1)
            for n in range(2 * degree + 1)
        },
        "COLOR_0": np.concatenate([color, alpha], axis=1),
    }
    return {name: np.ascontiguousarray(column, "<f4") for name, column in columns.items()}


def gltf_axes(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rotation [3, 3] from world to glTF axes: y is the cameras' mean up, x nearly the
    first one's right.
    """
    up = up_direction(cameras)
    right, _, forward = (side - (side @ up) * up for side in cameras[0].rotation)
    if np.linalg.norm(right) < 0.5:  # the camera is rolled by 90 degrees: its right is nearly up
        right = forward
    right = unit_vectors(right)
    return np.stack([right, up, np.cross(right, up)])

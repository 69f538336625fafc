"""Gaussians as PLY files in PlayCanvas' compressed layout, which SuperSplat and splat-transform
read.

A file has up to three elements, little-endian. Chunk c has the bounds of Gaussians 256 c to 256 c +
255:

    chunk     float   min_x .. max_z, min_scale_x .. max_scale_z (natural logarithms),
                      min_r .. max_b (0.5 + SH)
    vertex    uint    packed_position, packed_scale   11, 10 and 11 bits of x, y, z, between the
                                                      bounds of the chunk
                      packed_rotation                 2 bits: index of the largest component of
                                                      wxyz; 10 for each other
                      packed_color                    8 for each of r, g, b, between the bounds, and
                                                      for the opacity
    sh        uchar   f_rest_0 .. as in an uncompressed PLY, -4 to 4

A number of b bits stands for k / (2^b - 1) of its range. The components of a quaternion lie between
-sqrt(1/2) and sqrt(1/2), the opacity between 0 and 1. A byte k of `sh` stands for (k + 0.5) / 256
of its range, but 0 and 255 stand for its ends.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData
from scipy.special import expit

from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import unit_quats
from morgs_mi.core.types import Arrays
from morgs_mi.io.ply import SH_DEGREES, columns_of, element, read_elements, rest_names
from morgs_mi.platform.checks import few, require
from morgs_mi.platform.files import atomic_path

_CHUNK = 256
_BOUNDS = {
    "position": ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"),
    "scale": (
        "min_scale_x",
        "min_scale_y",
        "min_scale_z",
        "max_scale_x",
        "max_scale_y",
        "max_scale_z",
    ),
    "color": ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b"),
}
_BOUND_NAMES = (*_BOUNDS["position"], *_BOUNDS["scale"], *_BOUNDS["color"])
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_XYZ_BITS = (11, 10, 11)
_ROTATION_BITS = (10, 10, 10)
_COLOR_BITS = (8, 8, 8, 8)
_MOST_LOG_SCALE = 20.0
_SH_RANGE = 4.0
# The components of a quaternion that are not the largest one, by its index.
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def write_compressed_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians as a compressed PLY file in their order, atomically.

    The precision of the positions depends on the extent of each 256 successive Gaussians, so they
    should be ordered by place (see `morgs_mi.playback.export.clips.in_z_order`). Logarithms of
    scales beyond -20 to 20 and SH coefficients of degree 1 to 3 beyond -4 to 4 are clipped. Motion
    and confidence are not written.

    Raises:
        OSError: the file cannot be written.
    """
    raw = gaussians.numpy()
    values = {
        "position": raw["means"],
        "scale": np.clip(raw["log_scales"], -_MOST_LOG_SCALE, _MOST_LOG_SCALE),
        "color": 0.5 + SH_C0 * raw["sh_coeffs"][:, 0],
    }
    starts = np.arange(0, len(raw["means"]), _CHUNK)
    bounds = []
    fractions = {}  # of the values between the bounds of their chunks
    for key, value in values.items():
        value = value.astype("<f4")
        least = np.minimum.reduceat(value, starts, axis=0)
        most = np.maximum.reduceat(value, starts, axis=0)
        bounds += [least, most]
        low = _by_row(least, len(value))
        high = _by_row(most, len(value))
        fractions[key] = (value - low) / np.where(high > low, high - low, 1)
    opacities = expit(raw["logit_opacities"].astype(np.float64))[:, None]
    colors = np.concatenate([fractions["color"], opacities], axis=1)
    words = (
        _packed(fractions["position"], _XYZ_BITS),
        _packed_rotations(unit_quats(gaussians)),
        _packed(fractions["scale"], _XYZ_BITS),
        _packed(colors, _COLOR_BITS),
    )
    elements = [
        element("chunk", np.concatenate(bounds, axis=1), _BOUND_NAMES),
        element("vertex", np.stack(words, axis=1), _PACKED),
    ]
    if raw["sh_coeffs"].shape[1] > 1:
        names = rest_names(raw["sh_coeffs"].shape[1])
        rest = raw["sh_coeffs"][:, 1:].transpose(0, 2, 1).reshape(len(colors), len(names))
        steps = np.clip(np.floor((rest / (2 * _SH_RANGE) + 0.5) * 256), 0, 255).astype("u1")
        elements.append(element("sh", steps, names))
    with atomic_path(path, "write_compressed_ply()") as partial:
        PlyData(elements, byte_order="<").write(str(partial))


def read_compressed_ply(path: str | Path) -> Gaussians:
    """Return the Gaussians in a compressed PLY file, SH of degree 0 to 3.

    Opacities are clipped to [1e-6, 1 - 1e-6], as in `Gaussians.from_activated`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a PLY file, is truncated, or lacks a property.
    """
    elements = read_elements(path)
    chunks = elements.get("chunk", {})
    vertices = elements.get("vertex", {})
    rest = elements.get("sh", {})
    N = len(vertices.get("packed_position", ()))
    K = 1 + len(rest) // 3
    expected = {
        **dict.fromkeys(_PACKED, ("u4", N)),
        **dict.fromkeys(_BOUND_NAMES, ("f4", -(-N // _CHUNK))),
        **dict.fromkeys(rest_names(K), ("u1", N)),
    }
    columns = {**chunks, **vertices, **rest}
    stored = {name: (column.dtype.str[1:], len(column)) for name, column in columns.items()}
    faults = [name for name, kind in expected.items() if stored.get(name) != kind]
    require(
        not faults and len(rest) in SH_DEGREES,
        path,
        f"expected a compressed PLY of {N} Gaussians, with the bounds of positions, sizes and "
        f"colours in chunks of {_CHUNK}, and SH of degree 0 to 3",
        f"{len(rest)} SH coefficients and another number or type of {few(faults)}",
        "export it again with SuperSplat or splat-transform",
    )
    position, scale = (
        _between(chunks, key, _unpacked(vertices[f"packed_{key}"], _XYZ_BITS))
        for key in ("position", "scale")
    )
    color = _unpacked(vertices["packed_color"], _COLOR_BITS)
    base = _between(chunks, "color", color[:, :3])
    coeffs = np.empty((N, K, 3), np.float32)
    coeffs[:, 0] = (base - 0.5) / SH_C0
    if rest:
        steps = columns_of(rest, rest_names(K)).reshape(N, 3, K - 1).transpose(0, 2, 1)
        parts = np.where(steps == 0, 0, np.where(steps == 255, 256, steps + 0.5))
        coeffs[:, 1:] = (parts / 128 - 1) * _SH_RANGE
    quats = _unpacked_rotations(vertices["packed_rotation"])
    with np.errstate(over="ignore"):  # infinite, and therefore invalid
        return Gaussians.from_activated(position, np.exp(scale), quats, color[:, 3], coeffs)


def _between(chunks: Arrays, key: str, fractions: np.ndarray) -> np.ndarray:
    """Return the values [N, 3] at fractions between the bounds of their chunks."""
    bounds = _by_row(columns_of(chunks, _BOUNDS[key]), len(fractions))
    low, high = np.hsplit(bounds, 2)
    # NaN where a bound is infinite: the Gaussians of the chunk are invalid.
    with np.errstate(invalid="ignore"):
        return low * (1 - fractions) + high * fractions


def _by_row(bounds: np.ndarray, N: int) -> np.ndarray:
    """Return the bounds [N, k] of each Gaussian's chunk, given the `bounds` [C, k] of C chunks."""
    return bounds.astype(np.float64).repeat(_CHUNK, axis=0)[:N]


def _packed(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return fractions [N, k] rounded to integers of these numbers of bits, the first one in the
    highest bits.
    """
    most = _most(bits).astype(fractions.dtype)
    steps = np.floor(np.clip(fractions, 0, 1) * most + 0.5).astype(np.uint32)
    return (steps << _shifts(bits)).sum(axis=1, dtype=np.uint32)


def _unpacked(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return the fractions [N, k] of the lowest bits, the inverse of `_packed`."""
    return (words.astype(np.uint32)[:, None] >> _shifts(bits) & _most(bits)) / _most(bits)


def _most(bits: tuple[int, ...]) -> np.ndarray:
    """Return the largest integers of these numbers of bits."""
    return (2 ** np.array(bits) - 1).astype(np.uint32)


def _shifts(bits: tuple[int, ...]) -> np.ndarray:
    """Return the places of integers of these numbers of bits, the last one in the lowest bits."""
    return (sum(bits) - np.cumsum(bits)).astype(np.uint32)


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4] as integers; q and -q, which are the same rotation, become the
    same one.
    """
    largest = np.abs(quats).argmax(axis=1)
    signs = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1, 1)
    others = np.take_along_axis(quats * signs, _OTHERS[largest], axis=1)
    return largest.astype(np.uint32) << np.uint32(30) | _packed(
        others * np.sqrt(0.5) + 0.5, _ROTATION_BITS
    )


def _unpacked_rotations(words: np.ndarray) -> np.ndarray:
    others = (_unpacked(words, _ROTATION_BITS) - 0.5) * np.sqrt(2)
    largest = (words >> np.uint32(30)).astype(np.int64)
    quats = np.empty((len(words), 4))
    np.put_along_axis(quats, _OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.maximum(1 - (others**2).sum(axis=1), 0))
    np.put_along_axis(quats, largest[:, None], rest[:, None], axis=1)
    return quats

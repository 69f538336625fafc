"""Gaussians as PLY files in the layout of 3D Gaussian Splatting, which the field's viewers and trainers read.

One vertex per Gaussian with float properties: ``x y z``, ``nx ny nz`` (zeros), ``f_dc_0..2``, ``f_rest_0..3(K-1)-1``
channel by channel (all of red, then green, then blue), ``opacity`` (logit), ``scale_0..2`` (natural logarithms of the
standard deviations), ``rot_0..3`` (w, x, y, z). World axes stay as they are; the layout does not prescribe any.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from morgs_mi.core.files import atomic_path
from morgs_mi.core.gaussians import Gaussians

__all__ = ["read_ply", "write_ply"]

_MEAN, _SCALE, _ROTATION = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_NORMAL, _DC = ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")


def write_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians as a binary PLY file, atomically.

    Quaternions are normalised. The layout has no motion and no confidence, so they are not written.

    Raises:
        OSError: the file cannot be written.
    """
    raw = gaussians.numpy()
    N, K = raw["sh_coeffs"].shape[:2]
    lengths = np.linalg.norm(raw["quats"], axis=1, keepdims=True)
    columns = [
        raw["means"],
        np.zeros((N, 3)),
        raw["sh_coeffs"][:, 0],
        raw["sh_coeffs"][:, 1:].transpose(0, 2, 1).reshape(N, 3 * (K - 1)),
        raw["logit_opacities"][:, None],
        raw["log_scales"],
        np.where(lengths > 0, raw["quats"] / np.maximum(lengths, 1e-30), (1, 0, 0, 0)),  # zero is no rotation
    ]
    names = (*_MEAN, *_NORMAL, *_DC, *_rest(K), "opacity", *_SCALE, *_ROTATION)
    table = np.concatenate(columns, axis=1, dtype=np.float32, casting="same_kind")
    vertices = table.astype("<f4").view([(name, "<f4") for name in names])[:, 0]
    with atomic_path(path, "write_ply()") as partial:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(partial))


def read_ply(path: str | Path) -> Gaussians:
    """Return the Gaussians in a PLY file of this package or of another tool: binary or text, SH of degree 0 to 3.

    Normals and properties outside the layout are ignored; without ``f_rest_*`` the degree is 0.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a PLY file, is truncated, lacks a property, or has a number that is not finite.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: expected a PLY file, found none; check the path.")
    try:
        ply = PlyData.read(str(path), mmap=cast(str, False))  # a bool is allowed, but the annotation lacks it
        elements = {element.name: element for element in ply}
    except (PlyParseError, ValueError, IndexError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a complete PLY file, got one that cannot be read: {error}.") from error
    properties = elements["vertex"].properties if "vertex" in elements else ()
    names = {p.name for p in properties if not isinstance(p, PlyListProperty)}
    if "packed_position" in names:
        raise ValueError(
            f"{path}: expected an uncompressed PLY, got SuperSplat's compressed one; export it uncompressed."
        )
    missing = [name for name in (*_MEAN, *_DC, "opacity", *_SCALE, *_ROTATION) if name not in names]
    if missing:
        raise ValueError(
            f"{path}: expected the vertices of a Gaussian splat, got a PLY without {', '.join(missing)}; "
            "a point cloud can initialise a fit but is not its result."
        )
    found = sum(name.startswith("f_rest_") for name in names)
    degree = {0: 0, 9: 1, 24: 2, 45: 3}.get(found)
    if degree is None or not names.issuperset(_rest((degree + 1) ** 2)):
        raise ValueError(
            f"{path}: expected f_rest_0 to f_rest_8, 23 or 44 (SH of degree 1 to 3) or none, got {found} of them."
        )
    vertices, K = elements["vertex"], (degree + 1) ** 2

    def columns(wanted: tuple[str, ...]) -> np.ndarray:
        values = [np.asarray(vertices[name], np.float32) for name in wanted]
        bad = [name for name, value in zip(wanted, values, strict=True) if not np.isfinite(value).all()]
        if bad:
            raise ValueError(f"{path}: expected finite numbers, got others in {', '.join(bad)}; clean the Gaussians.")
        return np.stack(values, axis=1) if values else np.zeros((len(vertices.data), 0), np.float32)

    rest = columns(_rest(K)).reshape(len(vertices.data), 3, K - 1).transpose(0, 2, 1)
    coeffs = np.concatenate([columns(_DC)[:, None], rest], axis=1)
    return Gaussians(columns(_MEAN), columns(_SCALE), columns(_ROTATION), columns(("opacity",))[:, 0], coeffs)


def _rest(K: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(3 * (K - 1)))

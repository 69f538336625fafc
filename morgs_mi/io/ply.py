"""Gaussians as PLY files in the layout of 3D Gaussian Splatting, which the field's viewers and
trainers read.

One vertex per Gaussian with float properties: ``x y z``, ``nx ny nz`` (zeros), ``f_dc_0..2``,
``f_rest_0..3(K-1)-1`` channel by channel (all of red, then green, then blue), ``opacity`` (logit),
``scale_0..2`` (natural logarithms of the standard deviations), ``rot_0..3`` (w, x, y, z). World
axes stay as they are; the layout does not prescribe any.

Mitsuba's shape `ellipsoids` reads this layout, and one with all attributes: it makes an attribute
NAME of adjacent properties ``NAME_0``, ``NAME_1``, ... between ``nx ny nz`` and ``scale_0``. Their
values are activated, as the integrators read them: opacities and confidence in [0, 1], and SH with
coefficient k of colour component j at 3 k + j. The table of attributes has their
names and shapes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from morgs_mi.core.attributes import BY_ACTIVATED_NAME
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import unit_quats
from morgs_mi.core.types import Arrays
from morgs_mi.io.listing import existing_file
from morgs_mi.io.ply_kinds import as_3dgs
from morgs_mi.platform.checks import require
from morgs_mi.platform.files import atomic_path

_MEAN = ("x", "y", "z")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
# Bytes in which a header ends: that of SH of degree 3 and all attributes has 3 kB.
_LONGEST_HEADER = 65_536
# Beyond these, an opacity is 0 or 1 and a size is 0, which other tools store as infinite numbers.
_BOUNDS = {"opacity": (-99, 99), **dict.fromkeys(_SCALE, (-69, None))}
SH_DEGREES = {0: 0, 9: 1, 24: 2, 45: 3}
"""Degrees of SH by the number of properties ``f_rest_*``."""

# Attributes of the layout of Mitsuba whose properties have other names than in the other layout.
_MITSUBA = {
    name: attribute
    for name, attribute in BY_ACTIVATED_NAME.items()
    if name not in ("means", "scales", "quats")
}
_NORMAL = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")


def write_ply(
    path: str | Path, gaussians: Gaussians, layout: Literal["3dgs", "mitsuba"] = "3dgs"
) -> None:
    """Write Gaussians as a binary PLY file, atomically.

    Quaternions are normalised.

    Args:
        path: the file.
        gaussians: N Gaussians.
        layout: ``3dgs``, the layout of 3D Gaussian Splatting, which has no motion and no
            confidence; or ``mitsuba``, with all attributes for the shape `ellipsoids`, which tools
            other than Mitsuba and this package do not read.

    Raises:
        ValueError: another layout, or values that are not finite.
        OSError: the file cannot be written.
    """
    if layout not in ("3dgs", "mitsuba"):
        raise ValueError(f"write_ply(): `layout` must be 3dgs or mitsuba, got {layout!r}.")
    raw = gaussians.numpy()
    invalid = [name for name, values in raw.items() if not np.isfinite(values).all()]
    if invalid:
        raise ValueError(
            f"write_ply(): `gaussians` must be finite, got others in `{invalid[0]}`; leave them "
            "out by gaussians.select()."
        )
    columns = {_MEAN: raw["means"], _NORMAL: np.zeros_like(raw["means"])}
    N, K = raw["sh_coeffs"].shape[:2]
    if layout == "mitsuba":
        for name in ("sh_coeffs", *_MITSUBA):
            if (values := getattr(gaussians, name)) is not None:
                table = np.array(values).reshape(N, math.prod(values.shape[1:]))
                columns[tuple(f"{name}_{i}" for i in range(table.shape[1]))] = table
    else:
        columns[_DC] = raw["sh_coeffs"][:, 0]
        columns[rest_names(K)] = raw["sh_coeffs"][:, 1:].transpose(0, 2, 1).reshape(N, 3 * (K - 1))
        columns[("opacity",)] = raw["logit_opacities"][:, None]
    columns |= {_SCALE: raw["log_scales"], _ROTATION: unit_quats(gaussians)}
    names = [name for names in columns for name in names]
    table = np.concatenate([*columns.values()], axis=1, dtype="<f4", casting="same_kind")
    with atomic_path(path, "write_ply()") as partial:
        PlyData([element("vertex", table, names)], byte_order="<").write(str(partial))


def element(name: str, table: np.ndarray, properties: Sequence[str]) -> PlyElement:
    """Return the element of a PLY file that has the columns of a table as properties, in their
    type.
    """
    rows = table.view([(column, table.dtype) for column in properties])[:, 0]
    return PlyElement.describe(rows, name)


def columns_of(properties: Arrays, names: Sequence[str]) -> np.ndarray:
    """Return properties of an element of a PLY file as a table [N, names] in their type."""
    return np.stack([properties[name] for name in names], axis=1)


def read_ply(path: str | Path) -> Gaussians:
    """Return the Gaussians in a PLY file of this package or of another tool: binary or text, SH of
    degree 0 to 3.

    Normals and other harmless properties are ignored; without ``f_rest_*`` the degree is 0.
    Infinite logits of the opacities 0 and 1 and infinite logarithms of sizes of 0 are replaced by
    finite ones, as in `from_activated`. `ply_kinds` lists the kinds of Gaussians of other methods
    that are read. All attributes of the layout ``mitsuba`` of `write_ply` are read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a PLY file, is truncated, lacks a property, or holds another kind of
            Gaussians.
    """
    vertices = read_vertices(path)
    is_mitsuba = vertices.keys() >= {"sh_coeffs_0", "opacities_0"}
    sh_names = [name for name in vertices if name.startswith(("sh_coeffs_", "f_dc_", "f_rest_"))]
    K = len(sh_names) // 3
    attributes: dict[str, np.ndarray] = {}
    if is_mitsuba:
        sh_order = [f"sh_coeffs_{i}" for i in range(3 * K)]
        expected = (*_MEAN, *_SCALE, *_ROTATION)
        for name, attribute in _MITSUBA.items():
            names = [f"{name}_{i}" for i in range(attribute.width)]
            if vertices.keys() >= {*names}:
                values = columns_of(vertices, names).reshape(-1, *attribute.shape)
                attributes[attribute.name] = attribute.activation.inverse(values)
    else:
        vertices = as_3dgs(path, vertices)
        sh_order = [*_DC, *np.reshape(rest_names(max(K, 1)), (3, -1)).T.ravel().tolist()]
        expected = (*_MEAN, *_DC, "opacity", *_SCALE, *_ROTATION)
    if missing := [name for name in expected if name not in vertices]:
        raise ValueError(
            f"{path}: expected Gaussians in the layout of 3D Gaussian Splatting, got vertices "
            f"without {', '.join(missing)}, as of a mesh or a point cloud; export the Gaussians."
        )
    count = len(sh_names) - 3
    if count not in SH_DEGREES or {*sh_order} != {*sh_names}:
        raise ValueError(
            f"{path}: expected f_rest_0 to f_rest_8, 23, 44 or none, got {count} of them; "
            "export it again."
        )
    if not is_mitsuba:
        attributes["logit_opacities"] = _table(vertices, ("opacity",))[:, 0]
    return Gaussians(
        _table(vertices, _MEAN),
        _table(vertices, _SCALE),
        _table(vertices, _ROTATION),
        sh_coeffs=_table(vertices, sh_order).reshape(-1, K, 3),
        **attributes,
    )


def _table(vertices: Arrays, names: Sequence[str]) -> np.ndarray:
    """Return properties as a table [N, names], float32, within their bounds."""
    values = np.empty((len(vertices["x"]), len(names)), np.float32)
    with np.errstate(over="ignore"):  # infinite, and therefore invalid
        for i, name in enumerate(names):
            values[:, i] = np.clip(vertices[name], *_BOUNDS.get(name, (None, None)))
    return values


def read_vertices(path: str | Path) -> Arrays:
    """Return the properties of the vertices in a PLY file, binary or text, by name, each [N] in its
    stored type.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: as `read_elements`, or there are no vertices.
    """
    elements = read_elements(path)
    require("vertex" in elements, path, "expected vertices", [*elements], "export it again")
    return elements["vertex"]


def read_elements(path: str | Path) -> dict[str, Arrays]:
    """Return the properties of a PLY file, by the names of element and property, each [rows].

    Binary files are mapped into memory. Lists are refused, because each would become an object.

    Args:
        path: the file, binary or text.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a PLY file, has lists, or has fewer rows than its header claims.
    """
    existing_file(path, "a PLY file")
    try:
        with open(path, "rb") as file:
            header, end, _ = file.read(_LONGEST_HEADER).partition(b"end_header")
        if not end or b"\nproperty list" in header:
            raise ValueError("its header does not end, or has lists, as of the faces of a mesh")
        elements = PlyData.read(str(path), mmap="r").elements
        return {e.name: {name: e.data[name] for name in e.data.dtype.names} for e in elements}
    except (PlyParseError, ValueError, OverflowError, MemoryError) as error:
        raise ValueError(
            f"{path}: expected a complete PLY file, got one that cannot be read: {error}; copy or "
            "export it again."
        ) from error


def rest_names(K: int) -> tuple[str, ...]:
    """Return the names of the properties of K SH coefficients of degree 1 and higher."""
    return tuple(f"f_rest_{i}" for i in range(3 * (K - 1)))

"""PLY files with all attributes of the Gaussians, in the layout that Mitsuba's shape `ellipsoids`
reads.

The shape makes an attribute NAME of adjacent properties ``NAME_0``, ``NAME_1``, ... between ``nx ny
nz`` and ``scale_0``. Their values are activated, as the integrators read them: opacities and
confidence in [0, 1], and SH with coefficient k of colour component j at 3 k + j. Names and shapes
are those of the table of attributes.
"""

from __future__ import annotations

import numpy as np

from morgs_mi.core.attributes import BY_ACTIVATED_NAME, SIGMOID
from morgs_mi.core.gaussians import Gaussians

# Properties of the layout that hold no attribute of this form.
_GEOMETRY = ("means", "scales", "quats")
# Properties that have the same names in the layout of 3D Gaussian Splatting.
_COLUMNS = {
    name: name
    for name in ("x", "y", "z", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)))
}


def mitsuba_columns(gaussians: Gaussians) -> dict[tuple[str, ...], np.ndarray]:
    """Return the attributes beside means, scales and rotations as columns [N, names], by their
    names.
    """
    columns: dict[tuple[str, ...], np.ndarray] = {}
    for name in ("sh_coeffs", *BY_ACTIVATED_NAME):
        values = None if name in _GEOMETRY else getattr(gaussians, name)
        if values is not None:
            width = int(np.prod(values.shape[1:]))
            names = tuple(f"{name}_{i}" for i in range(width))
            columns[names] = np.array(values).reshape(len(gaussians), width)
    return columns


def from_mitsuba(
    vertices: dict[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return properties by the names of 3D Gaussian Splatting, and the raw attributes that it does
    not have.

    Args:
        vertices: properties [N] by name; those of another layout are returned as they are.
    """
    if not vertices.keys() >= {"sh_coeffs_0", "opacities_0"}:
        return vertices, {}
    K = sum(name.startswith("sh_coeffs_") for name in vertices) // 3
    places = _COLUMNS | {f"sh_coeffs_{i}": f"f_dc_{i}" for i in range(3)}
    for k in range(1, K):
        for c in range(3):
            places[f"sh_coeffs_{3 * k + c}"] = f"f_rest_{c * (K - 1) + k - 1}"
    columns = {places[name]: values for name, values in vertices.items() if name in places}
    columns["opacity"] = SIGMOID.inverse(vertices["opacities_0"])
    attributes: dict[str, np.ndarray] = {}
    for name, attribute in BY_ACTIVATED_NAME.items():
        names = [f"{name}_{i}" for i in range(attribute.width)]
        if name not in (*_GEOMETRY, "opacities") and vertices.keys() >= {*names}:
            table = np.stack([vertices[column] for column in names], axis=1)
            values = table.reshape(len(table), *attribute.shape)
            attributes[attribute.name] = attribute.activation.inverse(values)
    return columns, attributes

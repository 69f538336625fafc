"""Simple solids of the synthetic scenes, as Mitsuba dictionaries in world units."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from morgs_mi.core.types import SceneDict
from morgs_mi.extras.synth.scene import rotate, translate

Material = SceneDict


def ball(radius: float, material: Material, center: Sequence[float] = (0, 0, 0)) -> SceneDict:
    """Return a sphere."""
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": material}


def box(center: Sequence[float], half: Sequence[float], material: Material) -> SceneDict:
    """Return a box with half-widths `half` along the axes."""
    return {
        "type": "cube",
        "to_world": mi.ScalarTransform4f(translate(*center) @ np.diag([*half, 1])),
        "bsdf": material,
    }


def rod(
    start: Sequence[float], end: Sequence[float], radius: float, material: Material
) -> SceneDict:
    """Return a cylinder that is open at both ends."""
    return {
        "type": "cylinder",
        "p0": list(start),
        "p1": list(end),
        "radius": radius,
        "bsdf": material,
    }


def disk(center: Sequence[float], radius: float, material: Material) -> SceneDict:
    """Return a disk that faces up."""
    facing_up = translate(*center) @ rotate("x", -np.pi / 2) @ np.diag([radius, radius, 1, 1])
    return {"type": "disk", "to_world": mi.ScalarTransform4f(facing_up), "bsdf": material}

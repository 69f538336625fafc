"""Clouds and walls of Gaussians, as raw attributes or as `Gaussians`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from morgs_mi import Camera, Gaussians
from morgs_mi.core.attributes import BY_NAME, Attribute
from morgs_mi.core.color_space import SH_C0

Values = dict[str, np.ndarray]

CHANNELS = ("color", "alpha", "depth", "motion", "confidence")
RAW = ("means", "log_scales", "quats", "logit_opacities", "sh_coeffs", "motion", "logit_confidence")

# Rows that a test adds to the table of attributes: one with an activation, one of three floats.
NEW_ATTRIBUTES = (
    Attribute(
        "logit_roughness",
        (),
        "roughness",
        BY_NAME["logit_confidence"].activation,
        channel="roughness",
    ),
    Attribute("normals", (3,), "normals", channel="normal"),
)


@dataclass(frozen=True)
class ExtendedGaussians(Gaussians):
    """Gaussians with `NEW_ATTRIBUTES`."""

    logit_roughness: Any = None
    normals: Any = None


# --------------------------------------------------------------------------------------------------
#  Random clouds
# --------------------------------------------------------------------------------------------------


def make_scene(
    degree=1,
    n=10,
    seed=5,
    *,
    extent=(1.0, 0.8, 0.5),
    scales=(0.1, 0.4),
    logits=(-1.5, 1.5),
):
    """Return raw attributes of a random cloud; the default one overlaps and stays clear of cap and
    stop.

    Args:
        degree: of the spherical harmonics.
        n: number of Gaussians.
        seed: of all draws.
        extent: half the size of the box of the means, world units.
        scales: smallest and largest scale, world units.
        logits: smallest and largest logit of an opacity.
    """
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-np.array(extent), extent, (n, 3)),
        "log_scales": rng.uniform(*np.log(scales), (n, 3)),
        "quats": rng.normal(size=(n, 4)) * rng.uniform(0.5, 2, (n, 1)),
        "logit_opacities": rng.uniform(*logits, n),
        "sh_coeffs": rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.3 + 0.2,
        "motion": rng.normal(size=(n, 3)) * 0.1,
        "logit_confidence": rng.normal(size=n),
    }


def make_wide_scene(n=120):
    """Return raw attributes of a cloud that spans several tiles, with no two equal depths."""
    return make_scene(1, n, 7, extent=(1.5, 1.0, 0.5), scales=(0.02, 0.2), logits=(-2, 3))


def make_unit_scene(degree=1, n=10):
    """Return `make_scene` in float32 with unit quaternions, which Mitsuba and PLY files expect."""
    raw = make_scene(degree, n)
    raw["quats"] /= np.linalg.norm(raw["quats"], axis=1, keepdims=True)
    return as_float32(raw)


def as_float32(raw):
    """Return float64 attributes rounded to float32."""
    return {k: np.float32(v).astype(np.float64) for k, v in raw.items()}


def to_gaussians(raw, grad=False):
    """Return `Gaussians` of raw attributes, with gradients enabled on request."""
    gaussians = Gaussians(**raw)
    if grad:
        dr.enable_grad(*gaussians.items().values())
    return gaussians


# --------------------------------------------------------------------------------------------------
#  Objects and walls
# --------------------------------------------------------------------------------------------------


def isotropic(means, scale, opacity, sh_coeffs=0.0, **more):
    """Return isotropic, unrotated Gaussians.

    Args:
        means: centres [N, 3], world units.
        scale: standard deviations [N], or one for all, world units.
        opacity: opacities [N], or one for all.
        sh_coeffs: SH coefficients [N, K, 3], or a number or colour for the only one of all.
        more: further attributes.
    """
    n = len(means)
    scales = np.broadcast_to(np.reshape(scale, (-1, 1)), (n, 3))
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians.from_activated(
        means, scales, quats, np.full(n, opacity), np.zeros((n, 1, 3)) + sh_coeffs, **more
    )


def random_sheet(rng, n, extent, z):
    """Return n random points [n, 3] of a square of half size `extent` at depth z."""
    return np.stack([*rng.uniform(-extent, extent, (2, n)), np.full(n, z)], axis=1)


def ball(seed, count, width, height, median_scale, sh_degree=0):
    """Return Gaussians uniform in the unit ball, and a camera at distance 3 that sees 50 degrees
    horizontally.
    """
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    radius = np.cbrt(rng.uniform(size=(count, 1)))
    means = direction / np.linalg.norm(direction, axis=1, keepdims=True) * radius
    sh = 0.1 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(size=(count, 3)) - 0.5) / SH_C0
    scales = median_scale * np.exp(0.4 * rng.normal(size=(count, 3)))
    quats = rng.normal(size=(count, 4))
    gaussians = Gaussians.from_activated(means, scales, quats, rng.uniform(0.1, 0.95, count), sh)
    return gaussians, Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 50.0, width, height)

"""Small scenes, cameras and clouds of Gaussians that several test modules share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi import Camera, Gaussians, ellipsoids
from morgs_mi.core.attributes import BY_NAME, Attribute

# --------------------------------------------------------------------------------------------------
#  Renderer and plugin
# --------------------------------------------------------------------------------------------------

Values = dict[str, np.ndarray]

CHANNELS = ("color", "alpha", "depth", "motion", "confidence")
RAW = ("means", "log_scales", "quats", "logit_opacities", "sh_coeffs", "motion", "logit_confidence")
AOVS = "motion,confidence,depth"


# Rows that a test adds to the table of attributes: one with an activation, one of three floats.
NEW_ATTRIBUTES = (
    Attribute("logit_roughness", (), "roughness", BY_NAME["logit_confidence"].activation, channel="roughness"),
    Attribute("normals", (3,), "normals", channel="normal"),
)


@dataclass(frozen=True)
class ExtendedGaussians(Gaussians):
    """Gaussians with `NEW_ATTRIBUTES`."""

    logit_roughness: Any = None
    normals: Any = None


def make_scene(degree: int = 1, n: int = 10, seed: int = 5) -> Values:
    """Return raw attributes of a cloud that overlaps, spans several blocks and stays clear of cap and stop."""
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform((-1.0, -0.8, -0.5), (1.0, 0.8, 0.5), (n, 3)),
        "log_scales": rng.uniform(np.log(0.1), np.log(0.4), (n, 3)),
        "quats": rng.normal(size=(n, 4)) * rng.uniform(0.5, 2, (n, 1)),
        "logit_opacities": rng.uniform(-1.5, 1.5, n),
        "sh_coeffs": rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.3 + 0.2,
        "motion": rng.normal(size=(n, 3)) * 0.1,
        "logit_confidence": rng.normal(size=n),
    }


def make_camera(width: int = 21, height: int = 18) -> Camera:
    """Return a camera whose size no block divides, with an off-centre principal point and fx != fy."""
    camera = Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, width, height)
    K = camera.K + np.array([[0, 0, 1.3], [0, 2.0, -0.7], [0, 0, 0]])
    return Camera(K, camera.viewmat, width, height)


def make_wide_scene(n: int = 120) -> Values:
    """Return raw attributes of a cloud that spans several tiles, with no two equal depths."""
    rng = np.random.default_rng(7)
    return {
        "means": rng.uniform((-1.5, -1.0, -0.5), (1.5, 1.0, 0.5), (n, 3)),
        "log_scales": rng.uniform(np.log(0.02), np.log(0.2), (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "logit_opacities": rng.uniform(-2, 3, n),
        "sh_coeffs": rng.normal(size=(n, 4, 3)) * 0.3,
        "motion": rng.normal(size=(n, 3)) * 0.1,
        "logit_confidence": rng.normal(size=n),
    }


def make_wide_camera() -> Camera:
    """Return a camera of several tiles, whose last blocks extend beyond the image on both sides."""
    return Camera.look_at((0.3, -0.4, -3.0), (0, 0, 0), (0, -1, 0), 45.0, 101, 75)


def as_float32(raw: Values) -> Values:
    """Return float64 attributes rounded to float32."""
    return {k: np.float32(v).astype(np.float64) for k, v in raw.items()}


def to_gaussians(raw: Values, grad: bool = False) -> Gaussians:
    """Return `Gaussians` of raw attributes, with gradients enabled on request."""
    gaussians = Gaussians(**raw)
    if grad:
        dr.enable_grad(*gaussians.items().values())
    return gaussians


def make_unit_scene(degree: int = 1) -> Values:
    """Return `make_scene` in float32 with unit quaternions, which Mitsuba expects."""
    raw = make_scene(degree)
    raw["quats"] /= np.linalg.norm(raw["quats"], axis=1, keepdims=True)
    return as_float32(raw)


def make_sensor_camera() -> Camera:
    """Return `make_camera` with fx = fy, because Mitsuba's sensors have one focal length."""
    camera = make_camera()
    K = camera.K.copy()
    K[1, 1] = K[0, 0]
    return replace(camera, K=K)


def make_mitsuba_scene(gaussians: Any, film: dict | None = None, sensor: dict | None = None, **props: Any) -> Any:
    """Return a Mitsuba scene of one shape, `make_sensor_camera` and the integrator `gaussian_splat` with `props`."""
    return mi.load_dict(
        {
            "type": "scene",
            "gaussians": ellipsoids(gaussians),
            "sensor": {**make_sensor_camera().sensor(**(film or {})), **(sensor or {})},
            "integrator": {"type": "gaussian_splat", **props},
        }
    )

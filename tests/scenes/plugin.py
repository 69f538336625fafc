"""A Mitsuba scene of Gaussians with the integrator `gaussian_splat`."""

import mitsuba as mi
import numpy as np

from morgs_mi import ellipsoids
from tests.scenes.cameras import make_sensor_camera
from tests.scenes.gaussians import to_gaussians

AOVS = "motion, confidence,depth"


def make_mitsuba_scene(gaussians, film=None, sensor=None, **props):
    """Return a Mitsuba scene of one shape, `make_sensor_camera` and the integrator `gaussian_splat`
    with `props`.
    """
    return mi.load_dict(
        {
            "type": "scene",
            "gaussians": ellipsoids(gaussians),
            "sensor": {**make_sensor_camera().sensor(**(film or {})), **(sensor or {})},
            "integrator": {"type": "gaussian_splat", **props},
        }
    )


def plugin_image(raw, film=None, sensor=None, **props):
    return np.asarray(mi.render(make_mitsuba_scene(to_gaussians(raw), film, sensor, **props)))

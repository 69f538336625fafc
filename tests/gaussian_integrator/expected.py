"""The images that the plugin is to render, by the reference implementation."""

import numpy as np

from tests.reference import rasterize_view
from tests.scenes.cameras import make_sensor_camera


def to_linear(color):
    """Return the linear light of an sRGB-encoded colour, analytic for `complex_step`."""
    low = color.real <= 0.04045
    return np.where(low, color / 12.92, ((np.where(low, 1, color) + 0.055) / 1.055) ** 2.4)


def expected_image(raw, viewmat=None):
    """Return the reference image of an rgba film with all AOVs."""
    image = rasterize_view(raw, make_sensor_camera(), viewmat=viewmat)
    parts = [
        to_linear(image["color"]),
        *(image[name] for name in ("alpha", "motion", "confidence", "depth")),
    ]
    return np.concatenate(parts, axis=2)

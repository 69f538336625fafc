"""The space in front of the training cameras in which nothing stands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import in_image


def in_empty_space(cameras: Sequence[Camera], means: np.ndarray) -> np.ndarray:
    """Return the mask of means [N] that lie in the view of a camera, nearer than its near plane.

    This camera does not render them, so that nothing moves them away. In front of other cameras
    they are fog.

    Args:
        cameras: the training cameras.
        means: [N, 3], world units.
    """
    mask = np.zeros(len(means), bool)
    for camera in cameras:
        forward = np.asarray(camera.viewmat, np.float64)[2]
        depths = means @ forward[:3] + forward[3]
        near = np.flatnonzero((depths > 0) & (depths < camera.near))
        pixels, _ = camera.project(np.asarray(means[near], np.float64))
        mask[near] |= in_image(camera, pixels)
    return mask

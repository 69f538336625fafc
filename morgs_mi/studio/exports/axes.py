"""The axes of glTF: x to the right, y up, and the viewer on the positive z side of the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import up_direction


def gltf_axes(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rotation [3, 3] from world to glTF axes: y is the cameras' mean up, x nearly the
    first one's right.
    """
    up = up_direction(cameras)
    views = np.asarray(cameras[0].viewmat, np.float64)
    right, forward = (side - (side @ up) * up for side in (views[0, :3], views[2, :3]))
    if np.linalg.norm(right) < 0.5:  # the camera is rolled by 90 degrees: its right is nearly up
        right = forward
    right /= np.linalg.norm(right)
    return np.stack([right, up, np.cross(right, up)])

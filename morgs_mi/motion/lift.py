"""Optical flow of key views lifted to one 3D displacement per Gaussian, in closed form.

Beyond the paper: with the blend weights w fixed, the flow loss (eq. 7) is linear in the motion. On frame
t-1's grid, with frame t-1's Gaussians and the flow u from t-1 to t, each key view v gives
W_iv = sum_x w_i(x) and U_iv = sum_x w_i(x) u(x), and with J_v the Jacobian of its projection at the mean

    (sum_v W_iv J_v' J_v + lambda I) d_i = sum_v J_v' U_iv .

Adam moves a centre by its learning rate per step at most; starting from d_i, large motion is no longer slow.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.gaussians.gaussians import Gaussians
from morgs_mi.motion.cues import MotionCue
from morgs_mi.render.window import Window

__all__ = ["lift_flow"]

# The prior is worth this many fully covered pixels that stand still: who is hardly seen stays where it is.
_PRIOR_PIXELS = 0.3


def lift_flow(gaussians: Gaussians, windows: Mapping[int, Window], cues: Mapping[int, MotionCue]) -> np.ndarray:
    """Return the displacement d [N, 3], world units, that explains the key views' flow best.

    Args:
        gaussians: N Gaussians of frame t - 1.
        windows: onto the views, by view.
        cues: of the key views, by view; those without a window are not looked at.
    """
    means = gaussians.numpy()["means"].astype(np.float64)
    system, right = np.zeros((len(means), 3, 3)), np.zeros((len(means), 3))
    scale = []
    for view in sorted(cues.keys() & windows.keys()):
        cue, window = cues[view], windows[view]
        trusted = cue.onward_reliable[..., None].astype(np.float32)
        sums = window.backproject(gaussians, window.cut(np.concatenate([cue.onward * trusted, trusted], axis=2)))
        J = projection_jacobian(window.camera, means)
        system += sums[:, 2, None, None] * np.einsum("nij,nik->njk", J, J)
        right += np.einsum("nij,ni->nj", J, sums[:, :2])
        scale.append(np.median(np.sum(J[:, 0] ** 2, axis=1)))
    prior = _PRIOR_PIXELS * float(np.mean(scale)) if scale else 1.0
    return np.linalg.solve(system + prior * np.eye(3), right[..., None])[..., 0].astype(np.float32)


def projection_jacobian(camera: Camera, means: np.ndarray) -> np.ndarray:
    """Return d(pixel) / d(mean) [N, 2, 3] at world points [N, 3]; zero for points behind the near plane."""
    V = np.asarray(camera.viewmat, np.float64)
    x, y, z = (means @ V[:3, :3].T + V[:3, 3]).T
    inverse = np.where(z > camera.near, 1 / np.maximum(z, camera.near), 0)
    fx, fy, zero = camera.K[0, 0] * inverse, camera.K[1, 1] * inverse, np.zeros_like(z)
    J = np.stack([fx, zero, -fx * x * inverse, zero, fy, -fy * y * inverse], axis=1).reshape(-1, 2, 3)
    return J @ V[:3, :3]

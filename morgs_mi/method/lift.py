"""Optical flow of key views lifted to one 3D displacement per Gaussian, in closed form, and who moves at all.

Beyond the paper: with the blend weights w fixed, the flow loss (eq. 7) is linear in the motion. On frame
t-1's grid, with frame t-1's Gaussians and the flow u from t-1 to t, each key view v gives
W_iv = sum_x w_i(x) and u_iv = sum_x w_i(x) u(x) / W_iv, and with J_v the Jacobian of its projection at the mean

    (sum_v k_iv W_iv J_v' J_v + lambda I) d_i = sum_v k_iv W_iv J_v' u_iv .

Adam moves a centre by its learning rate per step at most; starting from d_i, large motion is no longer slow.

Flow bleeds over the edges of what moves, each view's onto another part of what stands still behind. So views are
trusted by how well they agree, k_iv = 1 / (1 + |u_iv - J_v d_i|^2 / s_iv^2) with s_iv = 0.2 px + |J_v d_i| / 5, in some
rounds of reweighting (Cauchy's cost r(e) = log(1 + |e|^2 / s^2)). And that it moves is told from noise by how much
more likely that makes the flows than if it stood still,

    e_i = sum_v a_iv (r(u_iv) - r(u_iv - J_v d_i)) / sum_v a_iv,    a_iv = W_iv / (W_iv + 1),

the mean over the key views that see it: i moves if e_i > 1 and its motion is more than the flow's own noise somewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.confidence import motion_floor
from morgs_mi.method.flow import FlowObservation
from morgs_mi.render.active_view import ActiveView

__all__ = ["Lift", "lift_flow"]

# The prior is worth this many fully covered pixels that stand still: who is hardly seen stays where it is.
_PRIOR_PIXELS = 0.3
_NOISE_PIXELS, _NOISE_SHARE = 0.2, 0.2
_ROUNDS = 4
# A view that covers a Gaussian by so many pixels counts half.
_HALF_SEEN = 1.0
_EVIDENT = 1.0
# Confidences of 0.88 and 0.12: soft, so that the pictures may still object.
_SURE = 2.0
_SLOPE = 4.0


@dataclass(frozen=True, eq=False)
class Lift:
    """What the key views' flow says of N Gaussians.

    Attributes:
        displacement: d [N, 3] since the frame before, world units; 0 for who does not move.
        logit_confidence: that it moves [N], from -2 to 2.
    """

    displacement: np.ndarray
    logit_confidence: np.ndarray


@dataclass(frozen=True, eq=False)
class _Seen:
    """A key view's flow at every Gaussian: W [N], u [N, 2] in px, J [N, 2, 3] and the least motion that counts."""

    weight: np.ndarray
    flow: np.ndarray
    jacobian: np.ndarray
    least: float

    def projected(self, d: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", self.jacobian, d)

    def cost(self, d: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Return r(u - J d), with the scale that suits a motion [N, 2] in px."""
        scale = _NOISE_PIXELS + _NOISE_SHARE * np.linalg.norm(motion, axis=1)
        return np.log1p(np.sum((self.flow - self.projected(d)) ** 2, axis=1) / scale**2)


def lift_flow(gaussians: Gaussians, windows: Mapping[int, ActiveView], cues: Mapping[int, FlowObservation]) -> Lift:
    """Return the displacements that explain the key views' flow best, and the evidence for them.

    Args:
        gaussians: N Gaussians of frame t - 1.
        windows: onto the views, by view.
        cues: of the key views, by view; those without a window are not looked at.
    """
    means = gaussians.numpy()["means"].astype(np.float64)
    views = [_seen(gaussians, means, windows[v], cues[v]) for v in sorted(cues.keys() & windows.keys())]
    if not views:
        return Lift(np.zeros((len(means), 3), np.float32), np.full(len(means), -_SURE, np.float32))
    d = _solved(views, [np.ones(len(means))] * len(views))
    for _ in range(_ROUNDS):
        d = _solved(views, [np.exp(-view.cost(d, view.projected(d))) for view in views])
    gain, seen, fast = np.zeros(len(means)), np.full(len(means), 1e-6), np.zeros(len(means), bool)
    for view in views:
        motion, a = view.projected(d), view.weight / (view.weight + _HALF_SEEN)
        gain += a * (view.cost(np.zeros_like(d), motion) - view.cost(d, motion))
        seen += a
        fast |= np.linalg.norm(motion, axis=1) > view.least
    logit = np.where(fast, np.clip(_SLOPE * (gain / seen - _EVIDENT), -_SURE, _SURE), -_SURE)
    return Lift(np.where(logit[:, None] > 0, d, 0).astype(np.float32), logit.astype(np.float32))


def _seen(gaussians: Gaussians, means: np.ndarray, window: ActiveView, cue: FlowObservation) -> _Seen:
    trusted = cue.forward_reliable[..., None].astype(np.float32)
    sums = window.backproject(gaussians, window.crop(np.concatenate([cue.forward_flow * trusted, trusted], axis=2)))
    flow = sums[:, :2] / np.maximum(sums[:, 2:], 1e-6)
    jacobian = projection_jacobian(window.camera, means)
    return _Seen(sums[:, 2].astype(float), flow.astype(float), jacobian, motion_floor(window.camera.width))


def _solved(views: list[_Seen], trust: list[np.ndarray]) -> np.ndarray:
    """Return d [N, 3] of the weighted system."""
    system, right, scale = 0, 0, []
    for view, k in zip(views, trust, strict=True):
        J, weight = view.jacobian, k * view.weight
        system = system + weight[:, None, None] * np.einsum("nij,nik->njk", J, J)
        right = right + np.einsum("nij,ni->nj", J, weight[:, None] * view.flow)
        scale.append(np.median(np.sum(J[:, 0] ** 2, axis=1)))
    prior = max(_PRIOR_PIXELS * float(np.mean(scale)), 1e-30)
    return np.linalg.solve(system + prior * np.eye(3), right[..., None])[..., 0]


def projection_jacobian(camera: Camera, means: np.ndarray) -> np.ndarray:
    """Return d(pixel) / d(mean) [N, 2, 3] at world points [N, 3]; zero for points behind the near plane."""
    V = np.asarray(camera.viewmat, np.float64)
    x, y, z = (means @ V[:3, :3].T + V[:3, 3]).T
    inverse = np.where(z > camera.near, 1 / np.maximum(z, camera.near), 0)
    fx, fy, zero = camera.K[0, 0] * inverse, camera.K[1, 1] * inverse, np.zeros_like(z)
    J = np.stack([fx, zero, -fx * x * inverse, zero, fy, -fy * y * inverse], axis=1).reshape(-1, 2, 3)
    return J @ V[:3, :3]

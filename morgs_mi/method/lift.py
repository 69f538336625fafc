"""Lifted flow: the optical flow of the key views as one 3D displacement per Gaussian, in closed
form.

Beyond the paper. With the blend weights w fixed, the flow loss (eq. 7) is linear in the motion. On
frame t-1's grid, with frame t-1's Gaussians and the flow u from t-1 to t, each key view v gives

    W_iv = sum_x w_i(x),    u_iv = sum_x w_i(x) u(x) / W_iv,

and with J_v the Jacobian of its projection at the mean, the displacement d_i of Gaussian i solves

    (sum_v k_iv W_iv J_v' J_v + lambda I) d_i = sum_v k_iv W_iv J_v' u_iv .

Adam moves a mean by at most its learning rate per step; starting from d_i, large motion is no
longer rate-limited. (TrackerSplat, 2026, solves similar normal equations for 2D affine maps of
point tracks and triangulates these.)

Flow bleeds over the edges of moving objects, in each view onto another part of the static
background. So a view's weight follows its agreement with the others, k_iv = 1 / (1 + |u_iv - J_v
d_i|^2 / s_iv^2) with s_iv = 0.2 px + |J_v d_i| / 5, by iteratively reweighted least squares
(Cauchy's cost r(e) = log(1 + |e|^2 / s^2)). Motion is separated from noise by how much better it
explains the flow than no motion does,

    e_i = sum_v a_iv (r(u_iv) - r(u_iv - J_v d_i)) / sum_v a_iv,    a_iv = W_iv / (W_iv + 1),

the mean over the key views that see the Gaussian: it moves if e_i > 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.flow import ViewFlow
from morgs_mi.method.flow_sources.flow_registry import NOISE_PX
from morgs_mi.method.motion_start import MotionStart
from morgs_mi.render.active_view import ViewGroup

# Numbers of a pixel that are summed per Gaussian.
_FLOW_MAPS = 3
# Weight of the prior that nothing moves, in fully covered pixels without motion: a Gaussian that is
# hardly visible stays in place.
_PRIOR_PIXELS = 0.3
# Growth of s with the motion, as a fraction of it: flow errors grow with the motion.
_NOISE_FRACTION = 0.2
# Rounds of reweighting; more change little.
_ROUNDS = 4
# Covered pixels at which a view's evidence counts half.
_HALF_WEIGHT_PIXELS = 1.0
# Evidence e_i above which a Gaussian moves.
_MIN_EVIDENCE = 0.5
LOGIT = 2.0
"""Logit of the confidence of a Gaussian that moves, 0.88, and negative of one that does not: soft
enough for the images to correct it.
"""


@dataclass(frozen=True, eq=False)
class _Flows:
    """Flow of V key views at N Gaussians."""

    weight: np.ndarray  # W [V, N]
    flow: np.ndarray  # u [V, N, 2], px
    jacobian: np.ndarray  # J [V, N, 2, 3], px per world unit

    @cached_property
    def squares(self) -> np.ndarray:
        """J' J [V, N, 3, 3]."""
        return np.einsum("vnij,vnik->vnjk", self.jacobian, self.jacobian)

    def project(self, d: np.ndarray) -> np.ndarray:
        """Return J d [V, N, 2] in px."""
        return np.einsum("vnij,nj->vni", self.jacobian, d)

    def cost(self, d: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Return r(u - J d) [V, N] (see the module), with the scale s that belongs to a motion
        [V, N, 2] in px.
        """
        scale = NOISE_PX + _NOISE_FRACTION * np.linalg.norm(motion, axis=-1)
        return np.log1p(np.sum((self.flow - self.project(d)) ** 2, axis=-1) / scale**2)


def lift_flow(gaussians: Gaussians, flows: Sequence[ViewFlow]) -> MotionStart:
    """Return the displacements that explain the flow of the key views best, and the confidence that
    follows from it.

    Args:
        gaussians: N Gaussians of frame t - 1.
        flows: the key views with their flow.
    """
    if not flows:
        N = len(gaussians)
        return MotionStart(np.zeros((N, 3), np.float32), np.full(N, -LOGIT, np.float32))
    group = ViewGroup([each.view for each in flows])
    flow = group.crop([each.flow.forward_flow for each in flows])
    reliable = group.crop([each.flow.forward_reliable for each in flows])
    # u and 1 where the flow u is reliable; 0 elsewhere.
    maps = np.empty((*reliable.shape, _FLOW_MAPS), np.float32)
    maps[..., :2] = flow
    maps[..., 2] = 1
    maps *= reliable[..., None]
    sums = group.draw(gaussians).sums(from_numpy(mi.Float, maps), _FLOW_MAPS).astype(float)
    means = np.asarray(gaussians.means, np.float64)
    observed = _Flows(
        sums[..., 2],
        sums[..., :2] / np.maximum(sums[..., 2:], 1e-6),
        np.stack([view.camera.projection_jacobian(means) for view in group.views]),
    )
    d = _solve(observed, np.ones_like(observed.weight))
    for _ in range(_ROUNDS):  # iteratively reweighted least squares
        d = _solve(observed, np.exp(-observed.cost(d, observed.project(d))))
    moves = _evidence(observed, d) > _MIN_EVIDENCE
    return MotionStart(
        np.where(moves[:, None], d, 0).astype(np.float32),
        np.where(moves, LOGIT, -LOGIT).astype(np.float32),
    )


def _evidence(flows: _Flows, d: np.ndarray) -> np.ndarray:
    """Return the evidence e [N]: how much better d [N, 3] explains the flow than no motion does."""
    motion = flows.project(d)
    a = flows.weight / (flows.weight + _HALF_WEIGHT_PIXELS)
    gain = flows.cost(np.zeros_like(d), motion) - flows.cost(d, motion)
    return (a * gain).sum(axis=0) / a.sum(axis=0, initial=1e-6)


def _solve(flows: _Flows, trust: np.ndarray) -> np.ndarray:
    """Return d [N, 3] of the system with the weights k = `trust` [V, N]."""
    J = flows.jacobian
    weight = trust * flows.weight
    system = np.einsum("vn,vnjk->njk", weight, flows.squares)
    right = np.einsum("vnij,vni->nj", J, weight[..., None] * flows.flow)
    # lambda, which has the unit of J' J.
    scales = np.median(np.sum(J[:, :, 0] ** 2, axis=-1), axis=-1)
    prior = max(_PRIOR_PIXELS * float(np.mean(scales)), 1e-30)
    return np.linalg.solve(system + prior * np.eye(3), right[..., None])[..., 0]

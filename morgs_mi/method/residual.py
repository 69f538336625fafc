"""The gated residual: what changes from one frame to the next (eqs. 3, 8 and 12).

    A_t = A_{t-1} + m R_t,        R of the centres = motion + offset,        m = sigmoid(logit_confidence)

With two gates, m is about motion alone: it gates where Gaussians are and how they are turned, and leaves colour,
opacity and size free, for shadows and light change where nothing moves, and what is uncovered has to be filled. The
paper has one gate for everything.

The parameters are a dict of raw tensors, all zero at the start of a frame but for the confidence, which is
carried on. The centres' colour of degree 0 (`sh_dc`) and the rest (`sh_rest`) have learning rates of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.attributes import sigmoid
from morgs_mi.core.gaussians import Gaussians, repeat_each
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.lift import Lift

__all__ = ["apply_residual", "join_sh", "residual_parameters", "split_sh"]

# Below this gate a lifted motion is not scaled up to pass it whole.
_LEAST_GATE = 0.1
# What a confidence loses in a frame without evidence: where something has moved there is more to be put right.
_FORGOTTEN = 0.3
_APPEARANCE = ("sh_dc", "sh_rest", "logit_opacities", "log_scales")
_STATIC = ("log_scales", "quats", "logit_opacities")


def residual_parameters(previous: Gaussians, config: MotionConfig, lifted: Lift | None = None) -> dict[str, Any]:
    """Return the parameters of a frame's residual at their start: no change, confidence as before.

    Args:
        previous: N Gaussians of the frame before.
        config: which modules are on.
        lifted: what to start from, or None: no motion, and the confidence as before.
    """
    sh_dc, sh_rest = split_sh(previous.sh_coeffs)
    shapes = {"motion": previous.means, **{name: getattr(previous, name) for name in _STATIC}, "sh_dc": sh_dc}
    if sh_rest is not None:
        shapes["sh_rest"] = sh_rest
    if config.learn_offset:
        shapes["offset"] = previous.means
    parameters = {name: dr.zeros(mi.TensorXf, tuple(value.shape)) for name, value in shapes.items()}
    if config.learn_confidence:
        parameters["logit_confidence"] = previous.logit_confidence
    if lifted is not None:
        start = lifted.displacement
        if config.learn_confidence:
            if config.lift_confidence:
                kept = np.asarray(previous.logit_confidence) - _FORGOTTEN
                parameters["logit_confidence"] = mi.TensorXf(np.maximum(lifted.logit_confidence, kept))
            # The gate would shrink what the flow says; who hardly moves may stay shrunk.
            gate = np.asarray(sigmoid(parameters["logit_confidence"].array))
            start = start / np.maximum(gate, _LEAST_GATE)[:, None]
        parameters["motion"] = mi.TensorXf(start.astype(np.float32))
    return parameters


def apply_residual(previous: Gaussians, parameters: Mapping[str, Any], config: MotionConfig) -> Gaussians:
    """Return A_{t-1} + m R_t (eq. 12), whose `motion` and `offset` are the gated parts of what the centres have moved.

    Args:
        previous: N Gaussians of the frame before.
        parameters: as from `residual_parameters`.
        config: without `learn_confidence` the gate is 1.
    """
    logit = parameters.get("logit_confidence")
    gate = sigmoid(logit.array) if config.learn_confidence and logit is not None else None

    def gated(name: str) -> Any:
        change = parameters[name]
        if gate is None or (config.two_gates and name in _APPEARANCE):
            return change
        width = change.array.shape[0] // len(previous)
        return mi.TensorXf(repeat_each(gate, width) * change.array, tuple(change.shape))

    motion = gated("motion")
    offset = gated("offset") if "offset" in parameters else dr.zeros(mi.TensorXf, tuple(motion.shape))
    sh_dc, sh_rest = split_sh(previous.sh_coeffs)
    sh = join_sh(sh_dc + gated("sh_dc"), None if sh_rest is None else sh_rest + gated("sh_rest"))
    static = {name: getattr(previous, name) + gated(name) for name in _STATIC}
    confidence = previous.logit_confidence if logit is None else logit
    means = previous.means + (motion + offset)
    return replace(
        previous, means=means, sh_coeffs=sh, motion=motion, offset=offset, logit_confidence=confidence, **static
    )


def split_sh(sh_coeffs: Any) -> tuple[Any, Any]:
    """Return the constant coefficient [N, 1, 3] and the others [N, K - 1, 3], or None where there are none."""
    K = int(sh_coeffs.shape[1])
    return (sh_coeffs, None) if K == 1 else (sh_coeffs[:, :1], sh_coeffs[:, 1:])


def join_sh(sh_dc: Any, sh_rest: Any) -> Any:
    """Return the coefficients [N, K, 3] that `split_sh` took apart."""
    if sh_rest is None:
        return sh_dc
    N, K = int(sh_dc.shape[0]), int(sh_rest.shape[1]) + 1
    # One gather per part: every element is read once, so the adjoint needs no atomics.
    lane = dr.arange(mi.UInt32, N * K * 3)
    row, column = lane // (3 * K), lane % (3 * K)
    is_dc, mode = column < 3, dr.ReduceMode.NoConflicts
    concatenated = dr.gather(mi.Float, sh_dc.array, row * 3 + column, active=is_dc, mode=mode)
    concatenated += dr.gather(mi.Float, sh_rest.array, row * (3 * K - 3) + column - 3, active=~is_dc, mode=mode)
    return mi.TensorXf(concatenated, (N, K, 3))

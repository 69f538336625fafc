"""The gated residual: the change from one frame to the next (eqs. 3, 8 and 12).

    A_t = A_{t-1} + m R_t,    R of the means = motion + offset,    m = sigmoid(logit_confidence)

With two gates, m gates only the attributes of motion (means and rotations); colour, opacity and
size are free, because shadows and light change where nothing moves and uncovered background has to
be filled. The paper has one gate for all attributes. Which attribute belongs to which gate is a
column of the attribute table (`core.attributes`).

The parameters are a dict of raw tensors, which a frame starts at zero but for the confidence, which
carries over, and for what a `MotionStart` gives.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.attributes import ATTRIBUTES, BY_NAME, sigmoid
from morgs_mi.core.gaussians import Gaussians, repeat_each
from morgs_mi.core.types import Tensor, Tensors
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_start import MotionStart

# Gate below which a lifted motion is no longer scaled up to pass the gate at full length.
_MIN_GATE = 0.1
_RESIDUALS = tuple(a.name for a in ATTRIBUTES if a.gate is not None)


def residual_parameters(
    previous: Gaussians, config: MotionConfig, start: MotionStart | None = None
) -> Tensors:
    """Return the parameters of one frame's residual at their start.

    Args:
        previous: N Gaussians of the previous frame, with a confidence if it is learned.
        config: which modules are on.
        start: of motion, confidence and colour; None: all as in the previous frame, without motion.
    """
    shapes = {**previous.parameters(), "motion": previous.means, "offset": previous.means}
    names = [n for n in _RESIDUALS if n in shapes and (n != "offset" or config.learn_offset)]
    parameters = {name: dr.zeros(mi.TensorXf, tuple(shapes[name].shape)) for name in names}
    gate: np.ndarray | float = 1.0
    if config.learn_confidence:
        logit: Tensor = previous.logit_confidence
        if start is not None and config.lift_confidence:
            logit = from_numpy(mi.TensorXf, start.logit_confidence)
        # The gate would shrink the displacement; a Gaussian that hardly moves may stay shrunk.
        gate = np.maximum(np.asarray(sigmoid(logit.array)), _MIN_GATE)[:, None]
        parameters["logit_confidence"] = logit
    if start is None:
        return parameters
    parameters["motion"] = from_numpy(mi.TensorXf, start.displacement / gate)
    if start.rotation is not None:
        parameters["quats"] = from_numpy(mi.TensorXf, start.rotation / gate)
    if start.color_change is not None:
        parameters["sh_dc"] = from_numpy(mi.TensorXf, start.color_change[:, None])
    return parameters


def apply_residual(previous: Gaussians, parameters: Tensors, config: MotionConfig) -> Gaussians:
    """Return A_{t-1} + m R_t (eq. 12); its `motion` is the displacement of the means.

    The displacement is the sum of the flow-guided motion and the learned offset (eq. 8), which is
    `offset`.

    Args:
        previous: N Gaussians of the previous frame.
        parameters: as from `residual_parameters`; without a confidence the gate is 1 (eq. 3).
        config: one gate or two.
    """
    logit = parameters.get("logit_confidence")
    gate = None if logit is None else sigmoid(logit.array)

    def gated(name: str) -> Tensor:
        change = parameters[name]
        if gate is None or (config.two_gates and BY_NAME[name].gate == "appearance"):
            return change
        width = change.array.shape[0] // len(previous)
        return mi.TensorXf(repeat_each(gate, width) * change.array, tuple(change.shape))

    motion = gated("motion")
    offset = (
        gated("offset") if "offset" in parameters else dr.zeros(mi.TensorXf, tuple(motion.shape))
    )
    attributes = previous.parameters()
    others = [
        name
        for name in parameters
        if name in attributes and name not in ("motion", "offset", "logit_confidence")
    ]
    values = {name: attributes[name] + gated(name) for name in others}
    displacement = motion + offset
    values |= {
        "means": attributes["means"] + displacement,
        "motion": displacement,
        "offset": offset,
    }
    dr.schedule(values)  # one kernel for all of a size
    return previous.with_parameters(
        values if logit is None else {**values, "logit_confidence": logit}
    )

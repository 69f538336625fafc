"""The first stage of a later frame with a motion model (see `method.motion_model`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import drjit as dr
import numpy as np

from morgs_mi.core.gaussians import displaced
from morgs_mi.core.types import Tensor
from morgs_mi.fit.optimise import Steps, adam, optimise, values_of
from morgs_mi.method.losses import recon_loss
from morgs_mi.method.motion_model import MotionModel, moved
from morgs_mi.method.motion_start import MotionProblem, MotionStart

# Learning rates at the end, as a fraction of those at the start.
_FINAL_RATE = 0.1


def fit_motion(
    problem: MotionProblem,
    model: MotionModel,
    start: MotionStart | None,
    steps: Steps,
    dssim_weight: float,
) -> tuple[MotionStart, dict[str, float]]:
    """Fit a motion model to the images by L_recon and the model's own losses.

    Args:
        problem: N Gaussians, the active views and their images.
        model: of their motion.
        start: displacement from which it starts, and colour from which the residual starts; None:
            none.
        steps: the steps, from the first one of the frame.
        dssim_weight: lambda of eq. 2.

    Returns:
        The start of the residual, with the confidence of `start` or of the previous frame, and the
        losses by name, means over the last round of views.
    """
    gaussians = problem.gaussians
    start = start or MotionStart.without_motion(problem.gaussians)
    start_gaussians = displaced(gaussians, start.displacement)

    def losses_at(parameters: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
        view = problem.views[index]
        image = view.render(moved(start_gaussians, *model.motion(parameters)), ("color",))
        return {
            "recon": recon_loss(image.color, problem.targets[index], dssim_weight, view.region),
            **model.losses(parameters),
        }

    optimizer = adam(model.parameters)
    total = len([*steps.views])
    # Adam's steps are as long as the rate; long ones find the motion, short ones settle it.
    decaying_steps = replace(steps, rate_factor=lambda step: _FINAL_RATE ** (step / total))
    losses = optimise(optimizer, model.rates, losses_at, decaying_steps)
    with dr.suspend_grad():
        displacement, rotation = model.motion(values_of(optimizer))
        change = moved(gaussians, displacement, rotation).quats - gaussians.quats
    displacement = start.displacement + np.asarray(displacement)
    return replace(start, displacement=displacement, rotation=np.array(change)), losses

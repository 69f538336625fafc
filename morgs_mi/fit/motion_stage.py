"""The first stage of a later frame with a motion model (see `method.motion_model`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import drjit as dr
import numpy as np

from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.core.types import Tensor
from morgs_mi.fit.optimise import Steps, adam, optimise, values_of
from morgs_mi.losses.losses import recon_loss
from morgs_mi.losses.ssim import Target
from morgs_mi.method.anchors import anchored_motion
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.hicom import coherent_motion
from morgs_mi.method.motion_grid import motion_grid
from morgs_mi.method.motion_model import MotionModel, moved
from morgs_mi.method.motion_start import MotionStart
from morgs_mi.method.transformation_cache import transformation_cache
from morgs_mi.render.active_view import ActiveView

__all__ = ["fit_motion", "motion_model"]

# Learning rates at the end, as a fraction of those at the start.
_FINAL_RATE = 0.1


def fit_motion(
    gaussians: Gaussians,
    model: MotionModel,
    start: MotionStart | None,
    views: Mapping[int, ActiveView],
    targets: Mapping[int, Target],
    order: Sequence[int],
    dssim_weight: float,
    on_step: Callable[[int], None] | None = None,
) -> tuple[MotionStart, dict[str, float]]:
    """Fit a motion model to the images by L_recon and the model's own losses.

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        model: of their motion.
        start: displacement from which it starts, and colour that the residual starts from; None: none.
        views: active views, by view index.
        targets: their images, by view index.
        order: the view of every step.
        dssim_weight: lambda of eq. 2.
        on_step: called with the number of steps done.

    Returns:
        The start of the residual, whose confidence is that of `start` or as before, and the losses by name, means over
        the last round of views.
    """
    logit = np.zeros(len(gaussians)) if gaussians.logit_confidence is None else gaussians.logit_confidence
    start = start or MotionStart(np.zeros((len(gaussians), 3), np.float32), np.array(logit, np.float32))
    begun = displaced(gaussians, start.displacement)

    def losses_at(parameters: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
        view = views[index]
        image = view.render(moved(begun, *model.motion(parameters)), ("color",))
        return {"recon": recon_loss(image.color, targets[index], dssim_weight, view.region), **model.losses(parameters)}

    optimizer = adam(model.parameters)
    # Adam's steps are as long as the rate; long ones find the motion, short ones settle it.
    steps = Steps(order, decay=lambda step: _FINAL_RATE ** (step / len(order)), on_step=on_step, last=len(views))
    losses = optimise(optimizer, model.rates, losses_at, steps)
    with dr.suspend_grad():
        displacement, rotation = model.motion(values_of(optimizer))
        change = moved(gaussians, displacement, rotation).quats - gaussians.quats
    displacement = start.displacement + np.asarray(displacement)
    return replace(start, displacement=displacement, rotation=np.array(change)), losses


def motion_model(
    gaussians: Gaussians, extent: float, config: MotionConfig, rng: np.random.Generator
) -> MotionModel | None:
    """Return the motion model of N Gaussians, None if there is none.

    Args:
        gaussians: of the previous frame, detached.
        extent: of the scene, world units.
        config: which model, and its settings.
        rng: draws its parameters.
    """
    match config.model:
        case "none":
            return None
        case "hicom":
            return coherent_motion(gaussians, extent, config.hicom)
        case "cache":
            return transformation_cache(gaussians, extent, rng, config.cache)
        case "grid":
            return motion_grid(gaussians, extent, config.grid)
        case "anchors":
            return anchored_motion(gaussians, extent, config.anchors)

"""The first frame: all attributes from its pictures, then the confidence from its masks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.losses import Target, mask_loss, recon_loss
from morgs_mi.fit.optimise import optimise, view_order
from morgs_mi.gaussians.gaussians import Gaussians
from morgs_mi.motion.residual import join_sh, split_sh
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize

__all__ = ["fit_confidence", "fit_first_frame"]


def fit_first_frame(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Sequence[Target],
    extent: float,
    config: FitConfig,
    render: RenderConfig,
    rng: np.random.Generator,
    on_step: Callable[[int], None] | None = None,
) -> tuple[Gaussians, dict[str, float]]:
    """Fit N Gaussians to the pictures of one instant by L_recon alone (eq. 2); the confidence is left alone.

    Args:
        gaussians: the start, e.g. from SfM points.
        cameras: V views.
        targets: their pictures.
        extent: of the scene in world units.
        config: steps and rates.
        render: cut-offs.
        rng: draws the views.
        on_step: called with the number of steps done.

    Returns:
        The fitted Gaussians and the final losses.
    """
    sh_dc, sh_rest = split_sh(gaussians.sh_coeffs)
    parameters = {name: getattr(gaussians, name) for name in ("means", "log_scales", "quats", "logit_opacities")}
    parameters |= {"sh_dc": sh_dc} | ({} if sh_rest is None else {"sh_rest": sh_rest})

    def assemble(values: Mapping) -> Gaussians:
        static = {name: values[name] for name in ("means", "log_scales", "quats", "logit_opacities")}
        rest = values["sh_rest"] if sh_rest is not None else None
        return replace(gaussians, sh_coeffs=join_sh(values["sh_dc"], rest), **static)

    def losses_of(values: Mapping, view: int) -> dict:
        image = rasterize(assemble(values), cameras[view], ("color",), config=render)
        return {"recon": recon_loss(image.color, targets[view], config.dssim_weight)}

    steps = config.first_frame_steps
    rates = config.first_rates.by_parameter(extent)
    views = view_order(len(cameras), steps, rng)
    fitted, losses = optimise(
        parameters, rates, views, losses_of, {}, decay=lambda step: 0.1 ** (step / steps), on_step=on_step
    )
    return assemble(fitted), losses


def fit_confidence(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    masks: Mapping[int, np.ndarray],
    config: FitConfig,
    render: RenderConfig,
    rng: np.random.Generator,
) -> tuple[Gaussians, dict[str, float]]:
    """Learn the confidence alone from motion masks [H, W] on key views (eq. 11); all else is frozen."""
    views = sorted(masks)
    targets = {view: mi.TensorXf(masks[view].astype(np.float32)) for view in views}

    def losses_of(values: Mapping, k: int) -> dict:
        posed = replace(gaussians, logit_confidence=values["logit_confidence"])
        image = rasterize(posed, cameras[views[k]], ("confidence",), detach_weights=("confidence",), config=render)
        return {"mask": mask_loss(image.confidence, targets[views[k]])}

    # Nothing else moves here, so the confidence may take long strides.
    rates = {"logit_confidence": 4 * config.rates.confidence}
    order = view_order(len(views), config.confidence_steps, rng)
    parameters = {"logit_confidence": gaussians.logit_confidence}
    fitted, losses = optimise(parameters, rates, order, losses_of, {})
    return replace(gaussians, logit_confidence=fitted["logit_confidence"]), losses

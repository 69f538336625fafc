"""The first frame: all attributes from its pictures, then the confidence from its masks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.density import plan_growth, resize_optimizer
from morgs_mi.fit.optimise import adam, optimise, replace_parameter, values_of, view_order
from morgs_mi.losses.attribution import densification_scores
from morgs_mi.losses.losses import mask_loss, recon_loss
from morgs_mi.losses.ssim import Target
from morgs_mi.method.residual import join_sh, split_sh
from morgs_mi.render.active_view import ActiveView
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
    """Fit Gaussians to the pictures of one instant by L_recon alone (eq. 2); the confidence is left alone.

    As in 3DGS, the bands of the spherical harmonics come in one after the other, each a thirtieth of the steps
    later, and between a tenth and a half of the steps Gaussians are born and die (see `density`): in the end there
    are `num_gaussians`, if that many are needed.

    Args:
        gaussians: the start, e.g. from SfM points.
        cameras: V views.
        targets: their pictures.
        extent: of the scene in world units.
        config: steps and rates.
        render: cut-offs.
        rng: draws the views and where Gaussians are born.
        on_step: called with the number of steps done.

    Returns:
        The fitted Gaussians and the final losses.
    """
    steps, degree, losses = config.first_frame_steps, gaussians.sh_degree, {}
    raises = [band * steps // 30 for band in range(1, degree + 1)]
    rounds = density_rounds(config)
    cuts = sorted({0, *raises, *rounds, steps})
    rates = config.first_frame_rates.by_parameter(extent)
    views = view_order(len(cameras), steps, rng)
    optimizer = adam(_static(gaussians))
    windows = [ActiveView(camera, render) for camera in cameras]
    for start, stop in pairwise(cuts):
        for _ in range(raises.count(start)):
            _add_band(optimizer, gaussians)
        if start in rounds:
            now = _assemble(gaussians, values_of(optimizer))
            need = densification_scores(now, windows, targets)
            births = -(-max(config.num_gaussians - len(now), 0) // (len(rounds) - rounds.index(start)))
            plan = plan_growth(now, need, births, config.num_gaussians, extent, config.density, rng)
            gaussians = gaussians.select(plan.parent)
            resize_optimizer(optimizer, plan, plan.edits)

        def losses_of(values: Mapping, view: int, shape: Gaussians = gaussians) -> dict:
            image = windows[view].render(_assemble(shape, values))
            return {"recon": recon_loss(image.color, targets[view], config.dssim_weight)}

        losses = optimise(
            optimizer, rates, views[start:stop], losses_of, {}, lambda step: 0.1 ** (step / steps), on_step, start
        )
    return _assemble(gaussians, values_of(optimizer)), losses


def density_rounds(config: FitConfig) -> list[int]:
    """Return the steps before which the first frame's density control acts, evenly from a tenth to a half."""
    steps = np.linspace(0.1, 0.5, config.density.rounds) * config.first_frame_steps
    return sorted(set(steps.astype(int).tolist()))


def _static(gaussians: Gaussians) -> dict[str, Any]:
    """Return the parameters at the start: all but the confidence and the higher bands."""
    names = ("means", "log_scales", "quats", "logit_opacities")
    return {name: getattr(gaussians, name) for name in names} | {"sh_dc": split_sh(gaussians.sh_coeffs)[0]}


def _assemble(base: Gaussians, values: Mapping) -> Gaussians:
    """Return `base` with the parameters in place of its own attributes, and as many bands as these have."""
    static = {name: values[name] for name in ("means", "log_scales", "quats", "logit_opacities")}
    return replace(base, sh_coeffs=join_sh(values["sh_dc"], values.get("sh_rest")), **static)


def _add_band(optimizer: Adam, base: Gaussians) -> None:
    """Let the next band of the spherical harmonics in, as it stands in `base`."""
    rest = np.asarray(base.sh_coeffs)[:, 1:]
    if "sh_rest" not in optimizer:
        optimizer["sh_rest"] = mi.TensorXf(np.ascontiguousarray(rest[:, :3]))
        return
    known = np.asarray(dr.detach(optimizer["sh_rest"]))
    width = (round((known.shape[1] + 1) ** 0.5) + 1) ** 2 - 1
    value = np.concatenate([known, rest[:, known.shape[1] : width]], axis=1)
    replace_parameter(
        optimizer, "sh_rest", value, lambda moment: np.pad(moment, [(0, 0), (0, width - known.shape[1]), (0, 0)])
    )


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
    optimizer = adam({"logit_confidence": gaussians.logit_confidence})
    losses = optimise(optimizer, rates, order, losses_of, {})
    return replace(gaussians, **values_of(optimizer)), losses

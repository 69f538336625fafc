"""The first frame: all attributes from its images, then the confidence from its masks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Tensor
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.density import plan_growth, resize_optimizer
from morgs_mi.fit.dropping import dropped
from morgs_mi.fit.optimise import adam, optimise, replace_parameter, values_of, view_order
from morgs_mi.losses.attribution import densification_scores
from morgs_mi.losses.losses import mask_loss, recon_loss
from morgs_mi.losses.ssim import Target
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
    """Fit Gaussians to the images of one instant by L_recon alone (eq. 2); the confidence stays unchanged.

    As in 3DGS, the bands of the spherical harmonics are added one after the other. Between a tenth and a half of the
    steps, rounds of density control (see `density`) let the Gaussians grow to `num_gaussians`, if so many are needed.

    Args:
        gaussians: the start, e.g. from SfM points.
        cameras: V views.
        targets: their images.
        extent: of the scene in world units.
        config: steps and rates.
        render: cut-offs.
        rng: draws the views and the means of births.
        on_step: called with the number of steps done.

    Returns:
        The fitted Gaussians, and the losses by name, means over the last steps.
    """
    steps, degree, losses = config.first_frame_steps, gaussians.sh_degree, {}
    band_steps = [int(band * steps * config.sh_band_fraction + 1e-9) for band in range(1, degree + 1)]
    rounds = density_rounds(config)
    rates = config.first_frame_rates.by_parameter(extent)
    order = view_order(len(cameras), steps, rng)
    optimizer = adam(_start(gaussians))
    views = [ActiveView(camera, render) for camera in cameras]
    for start, stop in pairwise(sorted({0, *band_steps, *rounds, steps})):
        for _ in range(band_steps.count(start)):
            _add_band(optimizer, gaussians)
        if start in rounds:
            now = gaussians.with_parameters(values_of(optimizer))
            scores = densification_scores(now, views, targets)
            births = -(-max(config.num_gaussians - len(now), 0) // (len(rounds) - rounds.index(start)))
            plan = plan_growth(now, scores, births, config.num_gaussians, extent, config.density, rng)
            gaussians = gaussians.select(plan.parent)
            resize_optimizer(optimizer, plan, plan.edits)

        def losses_at(values: Mapping[str, Tensor], view: int, base: Gaussians = gaussians) -> dict[str, Tensor]:
            image = views[view].render(dropped(base.with_parameters(values), config.dropping or 0.0, rng))
            return {"recon": recon_loss(image.color, targets[view], config.objective.dssim_weight)}

        losses = optimise(
            optimizer,
            rates,
            order[start:stop],
            losses_at,
            {},
            lambda step: config.final_rate ** (step / steps),
            on_step,
            start,
        )
    return gaussians.with_parameters(values_of(optimizer)), losses


def density_rounds(config: FitConfig) -> list[int]:
    """Return the steps of the first frame before which density control acts."""
    density = config.density
    steps = np.linspace(density.first_round, density.last_round, density.rounds) * config.first_frame_steps
    return sorted(set(steps.astype(int).tolist()))


def _start(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return the parameters at the start: those that the first frame fits, without the higher SH bands."""
    known = gaussians.parameters()
    return {a.name: known[a.name] for a in ATTRIBUTES if a.first_frame and a.name in known and a.name != "sh_rest"}


def _add_band(optimizer: Adam, base: Gaussians) -> None:
    """Add the next SH band to the parameters, with its values in `base`."""
    rest = np.asarray(base.sh_coeffs)[:, 1:]
    if "sh_rest" not in optimizer:
        optimizer["sh_rest"] = from_numpy(mi.TensorXf, rest[:, :3])
        return
    known = np.asarray(dr.detach(optimizer["sh_rest"]))
    width = (round((known.shape[1] + 1) ** 0.5) + 1) ** 2 - 1
    value = np.concatenate([known, rest[:, known.shape[1] : width]], axis=1)
    replace_parameter(
        optimizer, "sh_rest", value, lambda moment: np.pad(moment, [(0, 0), (0, width - known.shape[1]), (0, 0)])
    )


def fit_confidence(
    gaussians: Gaussians,
    cameras: Mapping[int, Camera],
    masks: Mapping[int, np.ndarray],
    config: FitConfig,
    render: RenderConfig,
    rng: np.random.Generator,
) -> tuple[Gaussians, dict[str, float]]:
    """Learn the confidence alone from motion masks on key views (eq. 11); all other attributes are frozen.

    Args:
        gaussians: N Gaussians with a confidence.
        cameras: by view index.
        masks: motion masks [H, W], by view index.
        config: steps and rates.
        render: cut-offs.
        rng: draws the views.

    Returns:
        The Gaussians with the learned confidence, and the losses by name.
    """
    views = sorted(masks)
    targets = {view: from_numpy(mi.TensorXf, masks[view]) for view in views}

    def losses_at(values: Mapping[str, Tensor], k: int) -> dict[str, Tensor]:
        posed = replace(gaussians, logit_confidence=values["logit_confidence"])
        image = rasterize(posed, cameras[views[k]], ("confidence",), detach_weights=("confidence",), config=render)
        return {"mask": mask_loss(image.confidence, targets[views[k]])}

    rates = {"logit_confidence": config.first_frame_rates.confidence}
    order = view_order(len(views), config.confidence_steps, rng)
    optimizer = adam({"logit_confidence": gaussians.logit_confidence})
    losses = optimise(optimizer, rates, order, losses_at, {})
    return replace(gaussians, **values_of(optimizer)), losses

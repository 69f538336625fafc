"""The fit of the first frame.

`fit_first_frame` fits all attributes but the confidence; up to the last round of density control,
the images have half the size. `fit_confidence` follows when the second frame, and with it the flow,
is there.

Dropout of Gaussians, which improves novel views (DropGaussian, Park et al. 2025).

Where training views are few or noisy, Gaussians overfit them together: one compensates for another
in a single view. In every step of the first frame, each Gaussian is left out with probability p,
and the opacities of the others are scaled by 1 / (1 - p). p follows from the number of views, their
noise and the angles between them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.attributes import ATTRIBUTES, sigmoid
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.progress import Progress
from morgs_mi.core.types import Tensors
from morgs_mi.fit.density import DensityControl
from morgs_mi.fit.detail import is_noisy
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import forecast
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.fit.optimise import (
    Steps,
    adam,
    fit_problem,
    optimise,
    pop_psnr,
    replace_parameter,
    values_of,
    view_order,
)
from morgs_mi.fit.view import half_sized
from morgs_mi.method.objective import SQUARED_ERROR, mask_loss, recon_loss
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

# Number of views that are fitted without dropout.
_MANY_VIEWS = 6
# Logit of an opacity that no cut-off of the renderer lets pass.
_INVISIBLE = -30.0
# Largest opacity, which has a finite logit.
_MOST = 0.999
# Probability with which few views are fitted that are noisy or far apart.
_DROPOUT = 0.2
# Least `Forecast.reach` of views that are far apart, degrees.
_FAR = 24.0


def dropped(gaussians: Gaussians, probability: float, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians as one step of the first frame renders them, differentiable.

    Args:
        gaussians: N Gaussians.
        probability: with which each is left out, below 1; 0: none is.
        rng: draws which.
    """
    if not probability:
        return gaussians
    is_kept = from_numpy(mi.UInt32, rng.random(len(gaussians), np.float32) >= probability) != 0
    opacity = dr.minimum(
        sigmoid(gaussians.logit_opacities.array) * dr.opaque(mi.Float, 1 / (1 - probability)), _MOST
    )
    logits = dr.select(is_kept, dr.log(opacity) - dr.log(1 - opacity), _INVISIBLE)
    return replace(gaussians, logit_opacities=mi.TensorXf(logits))


def adapted_to_images(config: FitConfig, problem: FirstFrameProblem) -> FitConfig:
    """Return the settings of the first frame with what follows from its images: dropout, and the
    loss of noisy ones.

    Noisy images are fitted by L1 alone if `noise_aware`. Few views that are noisy or far apart are
    fitted with dropout, unless it is given.
    """
    noisy = is_noisy([view.image for view in problem.views])
    if config.noise_aware and noisy:
        config = replace(config, objective=replace(config.objective, dssim_weight=0.0))
    if config.dropout is not None:
        return config
    views = len(problem.views)
    few = views < _MANY_VIEWS
    far = few and views > 1 and forecast(problem.cameras, problem.points).reach >= _FAR
    return replace(config, dropout=_DROPOUT if few and (noisy or far) else 0.0)


# Passes over all views over which the losses are averaged, and the least number of steps.
_AVERAGED_PASSES = 4
_LEAST_AVERAGED_STEPS = 8
# Fraction of the steps after which another SH band is added: 1000 of 30,000 steps in 3DGS.
BAND = 1 / 30
# First round of density control, as a fraction of the steps: before it, errors are everywhere.
_FIRST_ROUND = 0.1
LAST_ROUND = 0.5
"""Last round of density control, as a fraction of the steps: the remaining steps fit the births."""
# Learning rates at the end, as a fraction of those at the start.
_FINAL_RATE = 0.1


# Steps after which the clock is read, under a limit.
_CHECKED = 20
# Least number of steps under a limit.
_LEAST_STEPS = 50
# Time of a step with the full images relative to one with half of them.
_LATE = 2.0


class _Pace:
    """Planned steps of a fit, some of which are skipped evenly if it would exceed a limit of the
    clock.
    """

    def __init__(self, steps: int, limit: float | None) -> None:
        self._steps = steps
        self._limit = limit
        self._begin = self._checked = time.perf_counter()
        self._stride = 1.0
        self.position = 0.0  # planned steps that are done
        self.count = 0  # steps that were made

    def views(self, order: Iterator[int], stop: int) -> Iterator[int]:
        """Yield the view of each step before the planned step `stop`."""
        while self.position < stop:
            yield next(order)
            self.position += self._stride
            self.count += 1
            if self._limit is not None and self.count % _CHECKED == 0:
                dr.sync_thread()
                moment = time.perf_counter()
                seconds = (moment - self._checked) / _CHECKED
                self._checked = moment
                late = self._steps - max(self.position, LAST_ROUND * self._steps)
                early = max(LAST_ROUND * self._steps - self.position, 0)
                if early:
                    late *= _LATE
                left = max(self._begin + self._limit - moment, 1e-3)
                stride = min((early + late) * seconds / left, self._steps / _LEAST_STEPS)
                self._stride = max(stride, 1.0)


@dataclass(frozen=True, eq=False)
class FirstFrame:
    """Result of fitting the first frame."""

    gaussians: Gaussians  #: The fitted Gaussians.
    losses: dict[str, float]  #: Means over the last steps, by name.
    steps: int  #: Number of steps.
    psnr: float  #: Of the training views in the last steps, dB; NaN without a step.
    problem: str  #: A sentence if that is worse than a constant image; empty otherwise.


def fit_first_frame(
    problem: FirstFrameProblem,
    config: FitConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
    on_round: Callable[[Gaussians], None] | None = None,
    limit: float | None = None,
) -> FirstFrame:
    """Return Gaussians fitted to the images of one timestamp by L_recon (eq. 2); their confidence
    stays unchanged.

    As in 3DGS, the bands of the spherical harmonics are added one after the other. Between a tenth
    and a half of the planned steps, rounds of density control (see `density`) let the Gaussians
    grow to `num_gaussians`, if so many are needed.

    Args:
        problem: views and initial Gaussians.
        config: steps and rates.
        rng: draws the views and the means of births.
        progress: called with the numbers of steps made and of all steps.
        on_round: called with the Gaussians before each round of density control.
        limit: of the time, seconds, for which steps are skipped; None: none.
    """
    progress = progress or Progress()
    steps = config.planned_steps
    start = problem.start
    # Steps before which a band is added; 3 times a thirtieth of 30 is 3, and not below.
    bands = [int(band * steps * BAND + 1e-9) for band in range(1, start.sh_degree + 1)]
    rounds = density_rounds(config)
    parameters = start.parameters()
    names = [a.name for a in ATTRIBUTES if a.first_frame and a.name in parameters]
    # The higher bands follow.
    optimizer = adam({name: parameters[name] for name in names if name != "sh_rest"})
    rates = config.first_frame_rates.by_parameter(problem.extent)
    fit_views = half_sized(problem.views) if rounds else problem.views
    views = [ActiveView(view.camera, problem.render) for view in fit_views]
    targets = [Target(view.image, view.mask) for view in fit_views]

    def losses_at(parameters: Tensors, view: int) -> Tensors:
        gaussians = dropped(start.with_parameters(parameters), config.dropout or 0.0, rng)
        image = views[view].render(gaussians)
        target = targets[view]
        loss = recon_loss(image.color, target, config.objective.dssim_weight)
        return {"recon": loss, SQUARED_ERROR: target.mse}

    control = DensityControl(problem.cameras, config.density, problem.extent, rng)
    losses = {}
    order = iter(view_order(len(views), steps, rng))
    pace = _Pace(steps, limit)

    for first, stop in pairwise(sorted({0, *bands, *rounds, steps})):
        if on_round is not None and first in rounds:
            on_round(start.with_parameters(values_of(optimizer)))
        for _ in range(bands.count(first)):
            _add_band(optimizer, start)
        if first in rounds:
            if first == rounds[-1]:  # its scores come from the full images already
                views = [ActiveView(camera, problem.render) for camera in problem.cameras]
                targets = [Target(view.image, view.mask) for view in problem.views]
            gaussians = start.with_parameters(values_of(optimizer))
            missing = max(config.planned_gaussians - len(gaussians), 0)
            control.observe_views(gaussians, views, targets)
            del gaussians  # tensors that the next steps would keep in memory
            births = -(-missing // (len(rounds) - rounds.index(first)))
            start = start.select(control.step(optimizer, births).parent)
        chunk = Steps(
            pace.views(order, stop),
            rate_factor=lambda _: _FINAL_RATE ** (pace.position / steps),
            on_step=lambda _: progress(min(pace.position + 1, steps), steps),
            averaged_steps=max(_LEAST_AVERAGED_STEPS, _AVERAGED_PASSES * len(views)),
        )
        losses = optimise(optimizer, rates, losses_at, chunk)
    if pace.count < steps:  # perhaps the last ones were skipped
        progress(steps, steps)
    psnr = pop_psnr(losses)
    problem_text = fit_problem(psnr, (target.constant_error() for target in targets))
    gaussians = start.with_parameters(values_of(optimizer))
    return FirstFrame(gaussians, losses, pace.count, psnr, problem_text)


def density_rounds(config: FitConfig) -> list[int]:
    """Return the steps of the first frame before which density control acts."""
    steps = np.linspace(_FIRST_ROUND, LAST_ROUND, config.density.rounds) * config.planned_steps
    return sorted(set(steps.astype(int).tolist()))


def _add_band(optimizer: Adam, base: Gaussians) -> None:
    """Add the next SH band to the parameters, with its values in `base`."""
    rest = np.asarray(base.sh_coeffs)[:, 1:]
    if "sh_rest" not in optimizer:
        optimizer["sh_rest"] = from_numpy(mi.TensorXf, rest[:, :3])
        return
    coefficients = np.asarray(dr.detach(optimizer["sh_rest"]))
    next_degree = round((coefficients.shape[1] + 1) ** 0.5)
    width = (next_degree + 1) ** 2 - 1
    replace_parameter(
        optimizer,
        "sh_rest",
        np.concatenate([coefficients, rest[:, coefficients.shape[1] : width]], axis=1),
        lambda moment: np.pad(moment, [(0, 0), (0, width - coefficients.shape[1]), (0, 0)]),
    )


def fit_confidence(
    gaussians: Gaussians,
    cameras: Mapping[int, Camera],
    masks: Mapping[int, np.ndarray],
    config: FitConfig,
    render: RenderConfig,
    rng: np.random.Generator,
) -> tuple[Gaussians, dict[str, float]]:
    """Return Gaussians with a confidence that is learned from motion masks on key views (eq. 11);
    all other attributes are frozen.

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

    def losses_at(parameters: Tensors, view: int) -> Tensors:
        trial = replace(gaussians, logit_confidence=parameters["logit_confidence"])
        image = rasterize(
            trial, cameras[view], ("confidence",), detach_weights=("confidence",), config=render
        )
        num_pixels = cameras[view].width * cameras[view].height
        return {"mask": mask_loss(image.confidence, targets[view], num_pixels)}

    rates = {"logit_confidence": config.first_frame_rates.confidence}
    order = [views[k] for k in view_order(len(views), config.confidence_steps, rng)]
    optimizer = adam({"logit_confidence": gaussians.logit_confidence})
    losses = optimise(optimizer, rates, losses_at, Steps(order))
    return replace(gaussians, **values_of(optimizer)), losses

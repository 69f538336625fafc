"""The fit of the first frame.

`fit_first_frame` fits all attributes but the confidence; up to the last round of density control,
the images have half the size. `fit_confidence` follows when the second frame, and with it the flow,
is there.

Where training views are few or noisy, Gaussians overfit them together: one compensates for another
in a single view. Dropout prevents it (DropGaussian, Park et al. 2025): in every step of the first
frame, each Gaussian is left out with probability p, and the opacities of the others are scaled by
1 / (1 - p). p follows from the number of views, their noise and the angles between them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Tensors
from morgs_mi.core.view import View
from morgs_mi.fit.density import DensityControl
from morgs_mi.fit.detail import is_noisy
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import MANY_VIEWS, are_far_apart
from morgs_mi.fit.frozen_views import FirstSteps, is_recordable, kept, with_dropout
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.fit.optimise import (
    FINAL_RATE,
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
from morgs_mi.method.objective import SQUARED_ERROR, ObjectiveConfig, mask_loss, recon_loss
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.platform.progress import Progress
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.render_config import RenderConfig

# Probability with which few views are fitted that are noisy or far apart.
_DROPOUT = 0.2
# Passes over all views over which the losses are averaged: of fewer, a mean depends on the views
# that come last.
_AVERAGED_PASSES = 4
# Least number of steps over which they are averaged, of few views.
_LEAST_AVERAGED_STEPS = 8
# Fraction of the steps after which another SH band is added: 1000 of 30,000 steps in 3DGS.
BAND = 1 / 30
# First round of density control, as a fraction of the steps: before it, errors are everywhere.
_FIRST_ROUND = 0.1
LAST_ROUND = 0.5
"""Last round of density control, as a fraction of the steps: the remaining steps fit the births."""
# Steps after which the clock is read, under a limit: reading waits until they are computed.
_CHECKED = 20
# Least number of steps under a limit: after fewer, there is nothing to look at.
_LEAST_STEPS = 50
# Time of a step with the full images relative to one with the half-sized images, as measured.
_LATE = 2.0


def dropped(gaussians: Gaussians, probability: float, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians as one step of the first frame renders them, differentiable.

    Args:
        gaussians: N Gaussians.
        probability: with which each is left out, below 1; 0: none is.
        rng: draws which.
    """
    if not probability:
        return gaussians
    return with_dropout(gaussians, probability, kept(len(gaussians), probability, rng))


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
    few = len(problem.views) < MANY_VIEWS
    far = are_far_apart(problem.cameras, problem.points)
    return replace(config, dropout=_DROPOUT if few and (noisy or far) else 0.0)


class _Pace:
    """Planned steps of a fit, some of which are skipped evenly if it would exceed a limit of the
    clock.
    """

    def __init__(self, steps: int, limit: float | None, late: float) -> None:
        self._steps = steps
        self._limit = limit
        self._late = late
        self._begin = self._checked = time.perf_counter()
        self._stride = 1.0
        self.position = 0.0  # planned steps that are done
        self.count = 0  # steps that were made

    def done(self) -> tuple[float, float]:
        """Return how much is done, and of how much: seconds of the limit, or without one planned
        steps, in proportion to the time they take.
        """
        position = min(self.position + 1, self._steps)
        share = self._work(position) / self._work(self._steps)
        if self._limit is None:
            return self._steps * share, self._steps
        seconds = time.perf_counter() - self._begin
        # The least number of steps may take longer.
        return seconds, self._limit if seconds < self._limit else seconds / share

    def _work(self, position: float) -> float:
        """Return the time that the planned steps up to a position take, in units of a step with the
        half-sized images.
        """
        return position + (self._late - 1) * max(position - LAST_ROUND * self._steps, 0)

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
                work = self._work(self._steps) - self._work(self.position)
                steps_left = work / (self._work(self.position) - self._work(self.position - 1))
                left = max(self._begin + self._limit - moment, 1e-3)
                stride = min(steps_left * seconds / left, self._steps / _LEAST_STEPS)
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
        progress: called with the numbers of steps made and of all steps, in proportion to their
            time; with a limit, in seconds.
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
    views = _observed(half_sized(problem.views) if rounds else problem.views, problem.render)

    def losses_at(parameters: Tensors, view: int) -> Tensors:
        gaussians = dropped(start.with_parameters(parameters), config.dropout or 0.0, rng)
        image = render_view(gaussians, views[view])
        target = views[view].target
        loss = recon_loss(image.color, target, config.objective.dssim_weight)
        return {"recon": loss, SQUARED_ERROR: target.mse}

    def record() -> FirstSteps | None:
        """Return the steps in the views as recordings; None where they cannot be recorded."""
        if not is_recordable(views, ObjectiveConfig()):
            return None
        weight = config.objective.dssim_weight
        return FirstSteps(views, weight, config.dropout or 0.0, rng)

    steps_of_views = record()
    control = DensityControl(problem.cameras, config.density, problem.extent, rng)
    losses = {}
    order = iter(view_order(len(views), steps, rng))
    pace = _Pace(steps, limit, _LATE if rounds else 1.0)

    for first, stop in pairwise(sorted({0, *bands, *rounds, steps})):
        if on_round is not None and first in rounds:
            on_round(start.with_parameters(values_of(optimizer)))
        for _ in range(bands.count(first)):
            _add_band(optimizer, start)
        if first in rounds:
            if first == rounds[-1]:  # its scores come from the full images already
                views = _observed(problem.views, problem.render)
                steps_of_views = record()
            gaussians = start.with_parameters(values_of(optimizer))
            missing = max(config.planned_gaussians - len(gaussians), 0)
            control.observe_views(gaussians, views)
            del gaussians  # tensors that the next steps would keep in memory
            births = -(-missing // (len(rounds) - rounds.index(first)))
            start = start.select(control.step(optimizer, births).parent)
        chunk = Steps(
            pace.views(order, stop),
            rate_factor=lambda _: FINAL_RATE ** (pace.position / steps),
            on_step=lambda _: progress(*pace.done()),
            averaged_steps=max(_LEAST_AVERAGED_STEPS, _AVERAGED_PASSES * len(views)),
        )
        recorded_steps = steps_of_views.of(len(start)) if steps_of_views is not None else None
        losses = optimise(optimizer, rates, losses_at, chunk, recorded_steps=recorded_steps)
    if pace.count < steps:  # perhaps the last ones were skipped
        total = pace.done()[1]
        progress(total, total)
    psnr = pop_psnr(losses)
    problem_text = fit_problem(psnr, (view.target.constant_error() for view in views))
    gaussians = start.with_parameters(values_of(optimizer))
    return FirstFrame(gaussians, losses, pace.count, psnr, problem_text)


def _observed(views: Sequence[View], render: RenderConfig) -> list[ObservedView]:
    """Return whole views as they are rendered and compared."""
    return [
        ObservedView.of(ActiveView(view.camera, render), Target(view.image, view.mask))
        for view in views
    ]


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
    new_coefficients = rest[:, coefficients.shape[1] : width]
    replace_parameter(
        optimizer,
        "sh_rest",
        from_numpy(mi.TensorXf, np.concatenate([coefficients, new_coefficients], axis=1)),
        lambda m: from_numpy(
            mi.TensorXf, np.pad(m, [(0, 0), (0, new_coefficients.shape[1]), (0, 0)])
        ),
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
    views = {view: ActiveView(cameras[view], render) for view in sorted(masks)}
    targets = {view: from_numpy(mi.TensorXf, masks[view]) for view in views}

    def losses_at(parameters: Tensors, view: int) -> Tensors:
        trial = replace(gaussians, logit_confidence=parameters["logit_confidence"])
        image = render_view(trial, views[view], ("confidence",), detach_weights=("confidence",))
        pixel_share = opaque(mi.Float, 1 / (cameras[view].width * cameras[view].height))
        return {"mask": mask_loss(image.confidence, targets[view], pixel_share)}

    rates = {"logit_confidence": config.first_frame_rates.confidence}
    indices = [*views]
    order = [indices[k] for k in view_order(len(views), config.confidence_steps, rng)]
    optimizer = adam({"logit_confidence": gaussians.logit_confidence})
    losses = optimise(optimizer, rates, losses_at, Steps(order))
    return replace(gaussians, **values_of(optimizer)), losses

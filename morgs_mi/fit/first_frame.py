"""The fit of the first frame.

`fit_first_frame` fits all attributes but the confidence; up to the last round of density control,
the images have half the size. `fit_confidence` follows when the second frame, and with it the flow,
is there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice, pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.progress import Progress
from morgs_mi.core.types import Tensor
from morgs_mi.fit.density import Room, plan_growth
from morgs_mi.fit.dropping import dropped
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.optimise import (
    Steps,
    adam,
    optimise,
    replace_parameter,
    select_rows,
    values_of,
    view_order,
)
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.method.attribution import densification_scores
from morgs_mi.method.losses import mask_loss, recon_loss
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

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


@dataclass(frozen=True, eq=False)
class FirstFrame:
    """Result of fitting the first frame."""

    gaussians: Gaussians  #: The fitted Gaussians.
    losses: dict[str, float]  #: Means over the last steps, by name.
    steps: int  #: Number of steps.


def fit_first_frame(
    problem: FirstFrameProblem,
    config: FitConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
    on_round: Callable[[Gaussians], None] | None = None,
) -> FirstFrame:
    """Return Gaussians fitted to the images of one instant by L_recon (eq. 2); their confidence
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
    """
    fit = _FirstFrameFit(problem, config, rng, progress)
    steps = config.planned_steps
    losses = {}
    order = iter(view_order(len(problem.views), steps, rng))
    for start, stop in fit.chunks(steps):
        if on_round is not None and fit.has_round(start):
            on_round(fit.gaussians)
        fit.prepare(start)
        losses = fit.run(islice(order, stop - start), start, steps)
    return FirstFrame(fit.gaussians, losses, steps)


class _FirstFrameFit:
    """Optimiser of the first frame, and its events: SH bands and rounds of density control."""

    def __init__(
        self,
        problem: FirstFrameProblem,
        config: FitConfig,
        rng: np.random.Generator,
        progress: Progress | None,
    ) -> None:
        self._problem = problem
        self._config = config
        self._rng = rng
        self._progress = progress
        self._initial = problem.start
        self._optimizer = adam(_first_parameters(problem.start))
        self._rates = config.first_frame_rates.by_parameter(problem.extent)
        # Steps before which a band is added; 3 times a thirtieth of 30 is 3, and not below.
        self._bands = [
            int(band * config.planned_steps * BAND + 1e-9)
            for band in range(1, problem.start.sh_degree + 1)
        ]
        self._rounds = density_rounds(config)
        self._use_views(problem.halved() if self._rounds else problem)

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians with the current parameters."""
        return self._initial.with_parameters(values_of(self._optimizer))

    def chunks(self, steps: int) -> list[tuple[int, int]]:
        """Return (first step, end) of the chunks of steps without an event."""
        return list(pairwise(sorted({0, *self._bands, *self._rounds, steps})))

    def has_round(self, step: int) -> bool:
        """Return whether a round of density control is due before a step."""
        return step in self._rounds

    def prepare(self, step: int) -> None:
        """Do what is due before a step: an SH band, a round of density control, larger images."""
        for _ in range(self._bands.count(step)):
            _add_band(self._optimizer, self._initial)
        # Before the round, so that its scores come from the full images.
        if self._rounds and step == self._rounds[-1]:
            self._use_views(self._problem)
        if self.has_round(step):
            self._grow(len(self._rounds) - self._rounds.index(step))

    def run(self, views: Iterable[int], first: int, steps: int) -> dict[str, float]:
        """Make the steps of some views, from step `first` of `steps`; return the losses by name."""
        progress = self._progress
        chunk = Steps(
            views,
            first,
            rate_factor=lambda step: _FINAL_RATE ** (step / steps),
            on_step=None if progress is None else lambda count: progress(count, steps),
            averaged_steps=max(_LEAST_AVERAGED_STEPS, _AVERAGED_PASSES * len(self._views)),
        )
        return optimise(self._optimizer, self._rates, self._losses_at, chunk)

    def _use_views(self, problem: FirstFrameProblem) -> None:
        """Let the next steps fit the views of `problem`."""
        self._views = [ActiveView(camera, problem.render) for camera in problem.cameras]
        self._targets = [view.target for view in problem.views]

    def _losses_at(self, parameters: Mapping[str, Tensor], view: int) -> dict[str, Tensor]:
        gaussians = self._initial.with_parameters(parameters)
        gaussians = dropped(gaussians, self._config.dropping or 0.0, self._rng)
        image = self._views[view].render(gaussians, ("color",))
        weight = self._config.objective.dssim_weight
        return {"recon": recon_loss(image.color, self._targets[view], weight)}

    def _grow(self, rounds_left: int) -> None:
        """Add and prune Gaussians in the next of the rounds of density control that are left."""
        gaussians = self.gaussians
        config = self._config
        planned = config.planned_gaussians
        births = -(-max(planned - len(gaussians), 0) // rounds_left)
        room = Room(births, limit=planned)
        scores = densification_scores(gaussians, self._views, self._targets)
        problem = self._problem
        plan = plan_growth(
            gaussians, scores, room, problem.extent, config.density, self._rng, problem.cameras
        )
        select_rows(self._optimizer, plan.parent, plan.is_birth, plan.edits)
        self._initial = self._initial.select(plan.parent)


def density_rounds(config: FitConfig) -> list[int]:
    """Return the steps of the first frame before which density control acts."""
    steps = np.linspace(_FIRST_ROUND, LAST_ROUND, config.density.rounds) * config.planned_steps
    return sorted(set(steps.astype(int).tolist()))


def _first_parameters(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return the parameters that the first steps fit: all but the higher SH bands."""
    parameters = gaussians.parameters()
    names = [
        a.name for a in ATTRIBUTES if a.first_frame and a.name in parameters and a.name != "sh_rest"
    ]
    return {name: parameters[name] for name in names}


def _add_band(optimizer: Adam, base: Gaussians) -> None:
    """Add the next SH band to the parameters, with its values in `base`."""
    rest = np.asarray(base.sh_coeffs)[:, 1:]
    if "sh_rest" not in optimizer:
        optimizer["sh_rest"] = from_numpy(mi.TensorXf, rest[:, :3])
        return
    coefficients = np.asarray(dr.detach(optimizer["sh_rest"]))
    next_degree = round((coefficients.shape[1] + 1) ** 0.5)
    width = (next_degree + 1) ** 2 - 1
    value = np.concatenate([coefficients, rest[:, coefficients.shape[1] : width]], axis=1)
    replace_parameter(
        optimizer,
        "sh_rest",
        value,
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

    def losses_at(parameters: Mapping[str, Tensor], view: int) -> dict[str, Tensor]:
        trial = replace(gaussians, logit_confidence=parameters["logit_confidence"])
        image = rasterize(
            trial, cameras[view], ("confidence",), detach_weights=("confidence",), config=render
        )
        return {"mask": mask_loss(image.confidence, targets[view])}

    rates = {"logit_confidence": config.first_frame_rates.confidence}
    order = [views[k] for k in view_order(len(views), config.confidence_steps, rng)]
    optimizer = adam({"logit_confidence": gaussians.logit_confidence})
    losses = optimise(optimizer, rates, losses_at, Steps(order))
    return replace(gaussians, **values_of(optimizer)), losses

"""The optimisation loop: Adam on a dict of parameters, with dicts of losses and weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.arrays import from_numpy, rows_of
from morgs_mi.core.types import Arrays, Tensor, Tensors
from morgs_mi.fit.frozen_step import RecordedSteps
from morgs_mi.fit.view import decibels
from morgs_mi.method.error_per_gaussian import ErrorPerGaussian
from morgs_mi.method.objective import SQUARED_ERROR
from morgs_mi.render.kernel_recording import render_lock

FINAL_RATE = 0.1
"""Learning rates at the end of a fit whose rates decay, as a fraction of those at its start: long
steps find the place, short ones settle there.
"""

# PSNR of training views below which it is compared with constant images, dB. Recordings are fitted
# better; what changes in a later frame may be a surface of one colour.
_DOUBTFUL = 20.0
# Decibels by which the median of an image, to which L1 leads, may be worse than its mean.
_MEDIAN = 1.5


def adam(parameters: Tensors, momentum: float = 0.9) -> Adam:
    """Return Adam with these tensors, by name, at their start values.

    Args:
        parameters: the tensors.
        momentum: decay of the mean of the gradients from step to step (beta_1).
    """
    # Gradients of means over a million pixels are tiny: Adam's usual epsilon of 1e-8 would dominate
    # them. `optimise` sets the rate of each parameter, so the 1 is never used.
    return Adam(lr=1.0, params=dict(parameters), beta_1=momentum, epsilon=1e-15)


def values_of(optimizer: Tensors) -> Tensors:
    """Return the current parameters, detached."""
    return {name: dr.detach(optimizer[name]) for name in optimizer}


def replace_parameter(
    optimizer: Adam, name: str, value: Tensor, carry: Callable[[Tensor], Tensor]
) -> None:
    """Replace a parameter by one of another shape, and map Adam's moments to it, which are lost in
    an assignment.

    Args:
        optimizer: its learning rates and its count of steps stay.
        name: name of the parameter.
        value: its new value, detached.
        carry: maps a moment of the old shape to one of the new shape.
    """
    # Dr.Jit 1.5 has no public access to the moments. `largest` is None unless AMSGrad is used.
    old_state: Any = optimizer.state[name]
    _, is_promoted, rate, (steps, first, second, largest) = old_state
    shape = tuple(optimizer[name].shape)
    moments = [carry(mi.TensorXf(moment, shape)).array for moment in (first, second)]
    dr.schedule(value, moments)
    dr.enable_grad(value)
    state: Any = (value, is_promoted, rate, (steps, *moments, largest))
    optimizer.state[name] = state


def select_rows(
    optimizer: Adam,
    rows: np.ndarray,
    is_birth: np.ndarray,
    edits: Arrays | None = None,
) -> None:
    """Replace the parameters [N, ...] and their moments by rows of them [M, ...]; moments of births
    are 0.

    Args:
        optimizer: holds tensors of N rows; its learning rates and its count of steps stay.
        rows: int [M], indices of rows.
        is_birth: bool [M].
        edits: changes [M, ...] added to the parameters, by name.
    """
    lanes = from_numpy(mi.UInt32, rows)
    survives = from_numpy(mi.Bool, ~is_birth)
    for name in list(optimizer):
        value = rows_of(optimizer[name], lanes)
        if edits and name in edits:
            value = value + from_numpy(mi.TensorXf, edits[name])
        replace_parameter(optimizer, name, value, lambda moment: rows_of(moment, lanes, survives))
    dr.eval()


@dataclass(frozen=True)
class Steps:
    """Steps of an optimisation, one view each, and what is done beside them."""

    views: Iterable[int]  #: Index of the view of every step, as the losses take it.
    first_step: int = 0  #: Number of the first step.
    rate_factor: Callable[[int], float] | None = None  #: Step -> factor of all rates; None: 1.
    on_step: Callable[[int], None] | None = None  #: Called with the number of steps made.
    #: Reads further gradients from the backward passes: its term joins the losses of each step.
    observer: ErrorPerGaussian | None = None
    averaged_steps: int = 8  #: Number of last steps over which the losses are averaged.


def optimise(
    optimizer: Adam,
    rates: Mapping[str, float],
    losses_at: Callable[[Tensors, int], Tensors],
    steps: Steps,
    weights: Mapping[str, float] | None = None,
    recorded_steps: RecordedSteps | None = None,
) -> dict[str, float]:
    """Minimise the weighted sum of losses by one Adam step per view; the optimiser holds the
    parameters.

    Args:
        optimizer: an optimiser from `adam`, which is also a mapping of its parameters.
        rates: learning rate of each parameter.
        losses_at: (parameters, view) -> losses by name; a view may lack some of them.
        steps: the steps.
        weights: weights of the losses by name; 1 where not named.
        recorded_steps: the same steps as recordings; None: none.

    Returns:
        The mean of each loss over the last steps that had it, by name.

    Raises:
        FloatingPointError: the losses of the last steps are not finite.
    """
    # As Python numbers: Dr.Jit 1.5 multiplies a rate that is an array in place, once per step.
    base_rates = {name: float(rates[name]) for name in optimizer}
    rows: list[tuple[tuple[str, ...], Any]] = []  # names and values of the losses of each step
    observer = steps.observer

    def make_step(view: int, rates: Mapping[str, float]) -> None:
        optimizer.set_learning_rate(dict(rates))
        losses = losses_at(optimizer, view)
        total: Tensor = sum((weights or {}).get(name, 1.0) * loss for name, loss in losses.items())
        term = None if observer is None else observer.term
        with render_lock:
            dr.backward(total if term is None else total + term)
        if observer is not None:
            observer.collect()
        values = dr.empty(mi.Float, len(losses))
        for k, loss in enumerate(losses.values()):
            dr.scatter(values, dr.ravel(dr.detach(loss)), mi.UInt32(k))
        optimizer.step()
        rows.append((tuple(losses), values))

    def finish_recorded(recorded: RecordedSteps) -> None:
        pending = recorded.pending
        results = recorded.finish(optimizer) if pending else []
        if results is None:
            for view, rates in pending:
                make_step(view, rates)
        else:
            rows.extend((tuple(losses), [*losses.values()]) for losses in results)
            if observer is not None and results:
                observer.update(len(results), recorded.scores)

    step = steps.first_step
    for step, view in enumerate(steps.views, steps.first_step):
        factor = 1.0 if steps.rate_factor is None else steps.rate_factor(step)
        rates = {name: factor * rate for name, rate in base_rates.items()}
        if recorded_steps is None:
            make_step(view, rates)
        else:
            is_scored = observer is not None and observer.skip <= len(recorded_steps.pending)
            recorded_steps.step(optimizer, view, rates, is_scored)
            if recorded_steps.is_full:
                finish_recorded(recorded_steps)
        if steps.on_step is not None:
            steps.on_step(step + 1)
    if recorded_steps is not None:
        finish_recorded(recorded_steps)
    history: dict[str, list[float]] = {}
    for names, values in rows:
        for name, value in zip(names, np.asarray(values).tolist(), strict=True):
            history.setdefault(name, []).append(value)
    means = {
        name: float(np.mean(losses[-steps.averaged_steps :])) for name, losses in history.items()
    }
    broken_losses = [name for name, mean in means.items() if not np.isfinite(mean)]
    if broken_losses:
        raise FloatingPointError(
            f"optimise(): the losses {', '.join(broken_losses)} are not finite after {step + 1} "
            "steps; lower the learning rates."
        )
    return means


def pop_psnr(losses: dict[str, float]) -> float:
    """Remove the mean squared error from the losses, and return its PSNR, dB; NaN if there is
    none.
    """
    return float(decibels(losses.pop(SQUARED_ERROR, np.nan)))


def fit_problem(psnr: float, constant_errors: Iterable[float]) -> str:
    """Return a sentence if training views are worse than images of one grey; otherwise nothing.

    Args:
        psnr: of the fitted images, dB; NaN: nothing was fitted.
        constant_errors: mean squared errors of the best images of one grey, one for each view.
    """
    if not psnr < _DOUBTFUL:
        return ""
    constant_psnr = decibels(np.mean([*constant_errors]))
    if psnr >= constant_psnr - _MEDIAN:
        return ""
    return (
        f"the training views have {psnr:.1f} dB, worse than constant images with "
        f"{constant_psnr:.1f} dB: the fit diverged, had too few steps, or shows nothing; lower "
        "learning rates that were raised, and check the poses (morgs-mi info)"
    )


def view_order(num_views: int, steps: int, rng: np.random.Generator) -> list[int]:
    """Return the views of `steps` steps in random order: each is drawn once before any is drawn
    again.
    """
    epochs = -(-steps // num_views)
    return [int(view) for _ in range(epochs) for view in rng.permutation(num_views)][:steps]

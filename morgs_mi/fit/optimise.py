"""The optimisation loop: Adam on a dict of parameters, with dicts of losses and weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Arrays, Tensor, Tensors
from morgs_mi.fit.view import decibels
from morgs_mi.method.error_per_gaussian import ErrorPerGaussian
from morgs_mi.method.objective import SQUARED_ERROR
from morgs_mi.render.kernel_recording import render_lock

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
    optimizer: Adam, name: str, value: np.ndarray, carry: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Replace a parameter by one of another shape, and map Adam's moments to it, which are lost in
    an assignment.

    Args:
        optimizer: its learning rates and its count of steps stay.
        name: name of the parameter.
        value: its new value.
        carry: maps a moment of the old shape to one of the new shape.
    """
    # Dr.Jit 1.5 has no public access to the moments. `largest` is None unless AMSGrad is used.
    _, is_promoted, rate, (steps, first, second, largest) = optimizer.state[name]
    shape = tuple(optimizer[name].shape)
    moments = [from_numpy(mi.Float, carry(np.asarray(m).reshape(shape))) for m in (first, second)]
    dr.make_opaque(moments)
    optimizer[name] = from_numpy(mi.TensorXf, value)
    state: Any = (optimizer.state[name][0], is_promoted, rate, (steps, *moments, largest))
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

    def carry(moment: np.ndarray) -> np.ndarray:
        selection = moment[rows]
        selection[is_birth] = 0
        return selection

    edits = edits or {}
    for name in list(optimizer):
        value = np.asarray(dr.detach(optimizer[name]))[rows]
        replace_parameter(optimizer, name, value + edits[name] if name in edits else value, carry)


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
) -> dict[str, float]:
    """Minimise the weighted sum of losses by one Adam step per view; the optimiser holds the
    parameters.

    Args:
        optimizer: an optimiser from `adam`, which is also a mapping of its parameters.
        rates: learning rate of each parameter.
        losses_at: (parameters, view) -> losses by name; a view may lack some of them.
        steps: the steps.
        weights: weights of the losses by name; 1 where not named.

    Returns:
        The mean of each loss over the last steps that had it, by name.

    Raises:
        FloatingPointError: the losses of the last steps are not finite.
    """
    # As Python numbers: Dr.Jit 1.5 multiplies a rate that is an array in place, once per step.
    base_rates = {name: float(rates[name]) for name in optimizer}
    optimizer.set_learning_rate(base_rates)
    history = dict[str, list[Tensor]]()
    weights = weights or {}
    step = steps.first_step
    for step, view in enumerate(steps.views, steps.first_step):
        if steps.rate_factor is not None:
            factor = steps.rate_factor(step)
            optimizer.set_learning_rate({name: factor * rate for name, rate in base_rates.items()})
        losses = losses_at(optimizer, view)
        total: Tensor = sum(weights.get(name, 1.0) * loss for name, loss in losses.items())
        term = None if steps.observer is None else steps.observer.term
        with render_lock:
            dr.backward(total if term is None else total + term)
        if steps.observer is not None:
            steps.observer.collect()
        optimizer.step()
        for name, loss in losses.items():
            history.setdefault(name, []).append(dr.detach(loss))
        if steps.on_step is not None:
            steps.on_step(step + 1)
    means = {
        name: float(np.mean([np.asarray(loss).item() for loss in losses[-steps.averaged_steps :]]))
        for name, losses in history.items()
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

"""The one optimisation loop: Adam on a dict of parameters, a dict of losses, a dict of weights."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import drjit as dr
import numpy as np
from drjit.opt import Adam

__all__ = ["Losses", "optimise", "view_order"]

Losses = dict[str, Any]


def optimise(
    parameters: Mapping[str, Any],
    rates: Mapping[str, float],
    views: Iterable[int],
    losses_of: Callable[[Mapping[str, Any], int], Losses],
    weights: Mapping[str, float],
    decay: Callable[[int], float] | None = None,
    on_step: Callable[[int], None] | None = None,
) -> tuple[dict[str, Any], dict[str, float]]:
    """Minimise the weighted sum of losses by one Adam step per view.

    Args:
        parameters: tensors by name, the start.
        rates: learning rate of each parameter.
        views: the view of every step.
        losses_of: (parameters, view) -> losses by name; a view may leave some out.
        weights: of the losses by name; 1 where not named.
        decay: step -> factor on all rates; None: 1.
        on_step: called with the number of steps done.

    Returns:
        The parameters at the end, detached, and each loss's mean over the last steps that had it.

    Raises:
        FloatingPointError: the losses of the last steps are not finite.
    """
    # Gradients of means over a million pixels are tiny: Adam's usual epsilon of 1e-8 would drown them.
    optimizer = Adam(lr=1.0, params=dict(parameters), epsilon=1e-15)
    scale = {name: float(rates[name]) for name in parameters}
    # As Python numbers: Dr.Jit 1.5 multiplies a rate that is an array in place, once per step.
    optimizer.set_learning_rate(scale)
    history: dict[str, list[Any]] = {}
    for step, view in enumerate(views):
        if decay is not None:
            factor = decay(step)
            optimizer.set_learning_rate({name: factor * rate for name, rate in scale.items()})
        losses = losses_of(optimizer, view)
        dr.backward(sum(weights.get(name, 1.0) * loss for name, loss in losses.items()))
        optimizer.step()
        for name, loss in losses.items():
            history.setdefault(name, []).append(dr.detach(loss))
        if on_step is not None:
            on_step(step + 1)
    final = {name: float(np.mean([np.asarray(v).item() for v in values[-8:]])) for name, values in history.items()}
    broken = [name for name, value in final.items() if not np.isfinite(value)]
    if broken:
        raise FloatingPointError(
            f"optimise(): the losses {', '.join(broken)} are not finite after {len(history[broken[0]])} steps; "
            "lower the learning rates."
        )
    return {name: dr.detach(optimizer[name]) for name in parameters}, final


def view_order(num_views: int, steps: int, rng: np.random.Generator) -> list[int]:
    """Return `steps` views, each drawn once before any is drawn again."""
    epochs = -(-steps // num_views)
    return np.concatenate([rng.permutation(num_views) for _ in range(epochs)])[:steps].tolist()

"""A step of a fit as one recording (`dr.freeze`): rendering, losses, derivatives and Adam.

What a step computes takes a few launches; to trace it takes many times as long. A recording is
traced once and replayed in all views and frames with the same `StepSetting`. All that differs
between them is an argument of `frozen_step`, an array of a size that the setting gives: Dr.Jit
stores all other numbers, and the sizes of arrays that a step makes, in the recording. Gaussians,
blocks, lanes and lists therefore fill a part of larger arrays. What fills them up has no pixel, no
gradient and no weight, and parameters change by the same bits as by the plain steps of `optimise`.

The length of the lists is known afterwards. Where they were too short, `RecordedSteps.finish`
returns None, and the plain steps are made instead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.types import Float, Jit, Tensor, Tensors, UInt32
from morgs_mi.render.kernel_recording import recorded
from morgs_mi.render.padded_region import PaddedSizes, padded

Inputs = Mapping[str, Jit]
"""Arguments of a recording, trees of arrays."""

LossesOfStep = Callable[[Tensors, Inputs, Inputs, PaddedSizes, bool], "Losses"]
"""(Parameters, view, shared, sizes of its region, whether the step has densification scores) ->
losses. It compares by its value.
"""

# Room of an array relative to what it must hold when it is chosen, and the most that it may have
# later: sizes of neighbouring frames differ less.
_ROOM = 1.25
_MOST_ROOM = 2.0
# Entries of the lists per splat that are expected before the first steps have counted them.
_ENTRIES_PER_SPLAT = 8.0
# Growth of the lists that is expected of the next steps.
_GROWTH = 1.1
# Steps after which losses and lengths of lists are read at the latest.
_MOST_STEPS = 64


class Losses(NamedTuple):
    """Losses of a step."""

    by_name: Tensors  #: Scalars; those without a weight count with weight 1.
    entries: UInt32  #: Number of entries that the lists should have had [1].
    #: Zeros [N, 1] with gradients, and a scalar: its gradients there are the densification scores
    #: of the step; None: it has none.
    probe: tuple[Tensor, Tensor] | None = None


@dataclass(frozen=True)
class StepSetting:
    """All that a recording of a step depends on but for its arguments."""

    losses: LossesOfStep
    is_scored: bool  #: Whether it has densification scores.
    names: tuple[str, ...]  #: Of the losses of all views.
    weights: tuple[tuple[str, float], ...]  #: Of the losses.
    shapes: tuple[tuple[str, tuple[int, ...]], ...]  #: Of the parameters.
    decays: tuple[float, float]  #: Of Adam's moments.
    epsilon: float  #: Adam's.
    threads: int  #: Of Dr.Jit, which divide the adjoint (see `backend.sections`).
    sizes: PaddedSizes  #: Of the region.
    #: Lengths of the arrays of the view, then of the arrays that all views share. Dr.Jit does not
    #: check them: a recording that is replayed with arrays of other lengths writes out of bounds.
    lengths: tuple[int, ...]


def frozen_step(
    setting: StepSetting, state: Inputs, numbers: Float, view: Inputs, shared: Inputs
) -> dict[str, Jit]:
    """Return the state after a step.

    Args:
        setting: description of the step.
        state: parameters and Adam's two moments by name, densification scores, and the losses and
            lengths of the lists of the last steps, see `RecordedSteps`.
        numbers: Adam's scale of each parameter, and the number of the step.
        view: arrays of the view.
        shared: arrays of all views.
    """
    with dr.isolate_grad():
        arrays = {name: mi.Float(values) for name, values in state["parameters"].items()}
        dr.enable_grad(arrays)
        tensors = {name: mi.TensorXf(arrays[name], shape) for name, shape in setting.shapes}
        losses, entries, probe = setting.losses(
            tensors, view, shared, setting.sizes, setting.is_scored
        )
        weights = dict(setting.weights)
        total: Float = sum(weights.get(name, 1.0) * loss for name, loss in losses.items())
        scores = state["scores"]
        if probe is None:
            dr.backward(total)
        else:
            features, term = probe
            dr.backward(total + term)
            scores = dr.maximum(scores, dr.grad(features).array)
        parameters = {}
        first = {}
        second = {}
        for k, (name, values) in enumerate(arrays.items()):
            gradient = dr.grad(values)
            beta_1, beta_2 = setting.decays
            first[name] = dr.lerp(gradient, state["first"][name], beta_1)
            second[name] = dr.lerp(dr.square(gradient), state["second"][name], beta_2)
            change = first[name] * dr.rsqrt(second[name] + setting.epsilon**2)
            scale = dr.gather(mi.Float, numbers, mi.UInt32(k))
            parameters[name] = dr.fma(change, scale, dr.detach(values))
        # One row per step, of its losses and of the length of its lists.
        row = dr.gather(mi.Float, numbers, mi.UInt32(len(arrays)))
        width = len(setting.names) + 1
        place = dr.arange(mi.UInt32, _MOST_STEPS * width)
        column = place % width
        value = mi.Float(entries)
        for k, name in enumerate(setting.names):
            if name in losses:
                value = dr.select(column == k, mi.Float(dr.detach(losses[name])), value)
        report = dr.select(place // width == mi.UInt32(row), value, state["report"])
        moments = {"first": first, "second": second}
        return {"parameters": parameters, **moments, "scores": scores, "report": report}


class StepView(NamedTuple):
    """A view as arguments of its steps."""

    losses: LossesOfStep  #: Of `StepSetting`.
    names: tuple[str, ...]  #: Of its losses.
    sizes: PaddedSizes  #: Of its region, with any capacity.
    arrays: Inputs  #: Its arrays.


class Draw(NamedTuple):
    """Random arrays of a step."""

    rng: np.random.Generator  #: Of the fit; steps that are made again draw the same.
    arrays: Callable[[np.random.Generator], Inputs]  #: Draws them.


class RecordedSteps:
    """Steps of Adam by recordings, between the moments at which `finish` reads what they return.

    Args:
        views: by index.
        shared: arrays of all views.
        weights: of the losses by name; 1 where not named.
        num_splats: that are drawn in a view, at most.
        rows: number of Gaussians, the rows of the optimiser's parameters, and the number of rows
            that they are padded to.
        draw: further arrays of the view of each step; None: none.

    Attributes:
        pending: (view, rates, further arrays of the view) of the steps since `finish`.
    """

    def __init__(
        self,
        views: Mapping[int, StepView],
        shared: Inputs,
        weights: Mapping[str, float],
        num_splats: int,
        rows: tuple[int, int],
        draw: Draw | None = None,
    ) -> None:
        self.pending: list[tuple[int, Mapping[str, float]]] = []
        self._views = views
        self._shared = shared
        of_shared = _lengths(shared)
        self._lengths = {v: _lengths(view.arrays) + of_shared for v, view in views.items()}
        # Of all terms, also of those that act in other frames: a recording depends on the names.
        names = (name for view in views.values() for name in view.names)
        self._names = tuple(dict.fromkeys((*weights, *names)))
        self._weights = tuple(weights.items())
        self._num_splats = num_splats
        self._count, self._size = rows
        self._draw = draw
        self._first_state: Mapping[str, Jit] = {}  # state of the generator before `pending`
        self._state: dict[str, Jit] = {}
        self._first_steps: dict[str, int] = {}  # steps that each parameter had before `pending`
        self._capacity = 0

    @property
    def is_full(self) -> bool:
        """Whether `finish` must be called before the next step."""
        return len(self.pending) == _MOST_STEPS

    @property
    def scores(self) -> Float:
        """Densification scores of the steps that `finish` read, one for each Gaussian."""
        return padded(self._state["scores"], self._count)

    def step(
        self, optimizer: Adam, view: int, rates: Mapping[str, float], is_scored: bool = False
    ) -> None:
        """Make a step, which the optimiser has after `finish`.

        Args:
            optimizer: from `optimise.adam`.
            view: index of the view.
            rates: learning rate of each parameter.
            is_scored: whether its densification scores count.
        """
        if not self.pending:
            if self._draw is not None:
                self._first_state = self._draw.rng.bit_generator.state
            self._state = self._start(optimizer)
            self._capacity = _list_capacity(self._num_splats)
        steps = len(self.pending)
        decays = (optimizer.beta_1, optimizer.beta_2)
        scales = [
            np.float32(rates[name]) * _bias_correction(*decays, self._first_steps[name] + steps + 1)
            for name in optimizer.state
        ]
        numbers = from_numpy(mi.Float, np.array([*scales, steps]))
        losses, _, sizes, arrays = self._views[view]
        setting = StepSetting(
            losses,
            is_scored,
            self._names,
            self._weights,
            tuple((name, (self._size, *optimizer[name].shape[1:])) for name in optimizer.state),
            decays,
            optimizer.epsilon,
            dr.thread_count(),
            replace(sizes, capacity=self._capacity),
            self._lengths[view],
        )
        if self._draw is not None:
            arrays = {**arrays, **self._draw.arrays(self._draw.rng)}
        self._state = recorded(frozen_step, setting)(self._state, numbers, arrays, self._shared)
        self.pending.append((view, rates))

    def finish(self, optimizer: Adam) -> list[dict[str, float]] | None:
        """Return the losses of the steps since the last call, and give the optimiser their state;
        None, and leave it, if the lists of one of them were too long.
        """
        views = [self._views[view] for view, _ in self.pending]
        steps = len(views)
        report = np.asarray(self._state["report"]).reshape(_MOST_STEPS, -1)[:steps]
        self.pending = []
        most = int(report[:, -1].max())
        if list(entries_per_splat) == [_ENTRIES_PER_SPLAT]:
            entries_per_splat.clear()
        entries_per_splat.append(most / self._num_splats)
        if most >= self._capacity:  # a report has floats: a larger number may be rounded to it
            if self._draw is not None:
                self._draw.rng.bit_generator.state = self._first_state
            return None
        for name, (value, promoted, rate, (t, *_)) in list(optimizer.state.items()):
            width = int(dr.prod(value.shape[1:]))
            arrays = [
                padded(self._state[part][name], self._count * width)
                for part in ("parameters", "first", "second")
            ]
            dr.schedule(arrays)
            parameter = mi.TensorXf(arrays[0], tuple(value.shape))
            dr.enable_grad(parameter)
            moments: Jit = (t + steps, arrays[1], arrays[2], None)
            optimizer.state[name] = (parameter, promoted, rate, moments)
        dr.eval()
        losses = {name: report[:, k].tolist() for k, name in enumerate(self._names)}
        return [{name: losses[name][k] for name in view.names} for k, view in enumerate(views)]

    def _start(self, optimizer: Adam) -> dict[str, Jit]:
        """Return the state of the optimiser, padded."""
        state: dict[str, Jit] = {"parameters": {}, "first": {}, "second": {}}
        for name, (value, _, _, (_, first, second, _)) in optimizer.state.items():
            size = self._size * int(dr.prod(value.shape[1:]))
            parts = (dr.detach(value).array, first, second)
            for part, values in zip(state.values(), parts, strict=True):
                part[name] = padded(values, size)
        counts: dict[str, Jit] = {name: extra[0] for name, (*_, extra) in optimizer.state.items()}
        distinct = {count.index: count for count in counts.values()}
        steps = {index: int(count[0]) for index, count in distinct.items()}
        self._first_steps = {name: steps[count.index] for name, count in counts.items()}
        state["scores"] = dr.zeros(mi.Float, self._size)
        state["report"] = dr.zeros(mi.Float, _MOST_STEPS * (len(self._names) + 1))
        dr.make_opaque(state)
        return state


def _lengths(tree: Jit) -> tuple[int, ...]:
    """Return the lengths of the arrays of a tree."""
    if isinstance(tree, Mapping):
        return tuple(length for branch in tree.values() for length in _lengths(branch))
    return (dr.width(tree),)


@lru_cache(maxsize=4096)
def _bias_correction(beta_1: float, beta_2: float, step: int) -> np.float32:
    """Return the negative factor by which Adam corrects the rate of a step, from 1."""
    # As `drjit.opt` computes it, which raises to a power in an order of its own.
    count = mi.UInt32(step)
    kind: Jit = mi.Float if dr.backend_v(mi.Float) == dr.JitBackend.Metal else mi.Float64
    factor: Float = -dr.sqrt(1 - kind(beta_2) ** count) / (1 - kind(beta_1) ** count)
    return np.float32(mi.Float(factor)[0])


# --------------------------------------------------------------------------------------------------
#  Sizes, which outlive a frame like the recordings that have them
# --------------------------------------------------------------------------------------------------

sizes_by_name: dict[str, list[int]] = {}
entries_per_splat: deque[float] = deque([_ENTRIES_PER_SPLAT], maxlen=4)  # of the last steps


def room_for(name: str, number: int) -> int:
    """Return a size that holds a number, one that was returned before if it is not too large.

    Args:
        name: of what is counted.
        number: of them.
    """
    sizes = sizes_by_name.setdefault(name, [])  # the last one is the one that was returned last
    number = max(number, 64)
    most = _MOST_ROOM * number
    if sizes and number <= sizes[-1] <= most:
        return sizes[-1]
    size = min(
        (size for size in sizes if _GROWTH * number <= size <= most),
        default=-(-round(_ROOM * number) // 64) * 64,
    )
    sizes_by_name[name] = [*(other for other in sizes if other != size), size]
    return size


def _list_capacity(num_splats: int) -> int:
    """Return the size of the lists of some splats, one for each number of them if it can."""
    entries = round(_GROWTH * max(entries_per_splat) * num_splats)
    return room_for(f"entries of {num_splats}", entries)

"""Arrays that NumPy and Dr.Jit exchange.

Dr.Jit borrows NumPy's memory where it can, and reads it when a kernel runs: after the call that
passed it, when the caller may have written to it. The package therefore passes copies.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import prod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.core.types import Jit, Tensor
from morgs_mi.platform.checks import numbers, require

# Bytes: Dr.Jit aligns its own memory to as many.
_ALIGNMENT = 64


def from_numpy(kind: type[Jit], values: ArrayLike) -> Jit:
    """Return numbers as a Dr.Jit tensor [...], or flattened as an array [M], copied before this
    returns.

    Dr.Jit borrows the copy, and holds a reference to it until all kernels that read it have run. It
    is aligned, because packets can only be read from aligned memory, and kernels are compiled for
    either case.

    Args:
        kind: the result's type, such as `mi.TensorXf` or `mi.UInt32`.
        values: anything that `numpy.asarray` accepts, converted to the numbers of `kind`.

    Raises:
        ValueError: it is called inside a function under `dr.freeze`.
    """
    refuse_freezing("from_numpy()")
    source = np.asarray(values)
    dtype = np.dtype(dr.type_v(kind).name.lower())
    num_bytes = source.size * dtype.itemsize
    memory = np.empty(num_bytes + _ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % _ALIGNMENT
    copy = memory[first : first + num_bytes].view(dtype).reshape(source.shape)
    copy[...] = source
    return kind(copy if dr.is_tensor_v(kind) else copy.ravel())


def float_tensor(place: str, name: str, values: ArrayLike | Tensor) -> Tensor:
    """Return an argument as a float tensor: a `mi.TensorXf` itself, or a copy of numbers.

    Raises:
        ValueError: it is neither. Other Dr.Jit arrays would lose their gradients.
    """
    if isinstance(values, mi.TensorXf):
        return values
    require(
        not dr.is_array_v(values),
        place,
        f"`{name}` must be a NumPy array or a {mi.TensorXf.__module__}.TensorXf",
        f"a {type(values).__module__}.{type(values).__name__}",
        "convert it with mi.TensorXf(array, shape)",
    )
    return from_numpy(mi.TensorXf, numbers(place, name, values))


def refuse_freezing(place: str) -> None:
    """Raise an error while Dr.Jit records a function under `dr.freeze`.

    Dr.Jit 1.5 ends the process when memory that it has borrowed from NumPy is released in a
    recording.

    Raises:
        ValueError: Dr.Jit is recording.
    """
    require(
        not dr.flag(dr.JitFlag.FreezingScope),
        place,
        "expected a call outside dr.freeze",
        "one inside, which Dr.Jit cannot record",
        "call it before the frozen function and pass its result. The renderer records its own "
        "kernels",
    )


def opaque(kind: type[Jit], value: float | Jit) -> Jit:
    """Return a number in memory, an array of width 1, which kernels read instead of containing it;
    an array as it is.

    The widths and factors of a scene are the same in every step, and writing one takes a launch:
    the last numbers are kept. In a recording, the number is part of the code, because a recording
    refuses memory that is not its argument.
    """
    if dr.is_array_v(value):
        return value
    if dr.flag(dr.JitFlag.FreezingScope):
        return kind(value)
    return kind(_number(kind, value))  # an array of its own, which may be changed in place


@lru_cache(maxsize=4096)
def _number(kind: type[Jit], value: float) -> Jit:
    return dr.opaque(kind, value)


def concatenated(parts: Sequence[Jit]) -> Jit:
    """Return arrays, or trees of arrays, end to end; `dr.concat` would compile a kernel for every
    length.
    """
    whole: Any = None
    lane = dr.arange(mi.UInt32, sum(map(dr.width, parts)))
    mode = dr.ReduceMode.NoConflicts
    for part in parts:
        count = opaque(mi.UInt32, dr.width(part))
        is_inside = lane < count
        values = dr.gather(type(part), part, lane, active=is_inside, mode=mode)
        whole = values if whole is None else dr.select(is_inside, values, whole)
        lane = lane - count  # wraps around before the part: a large number
    return whole


def rows_of(tensor: Tensor, rows: Jit, active: Jit | bool = True) -> Tensor:
    """Return rows of a tensor [N, ...] as another one [M, ...], without gradients.

    Args:
        tensor: at least one row.
        rows: UInt32 [M], indices of rows.
        active: which of them are read [M]; the others are 0.
    """
    shape = tuple(tensor.shape)[1:]
    width = prod(shape)
    count = dr.width(rows)
    lane = dr.arange(mi.UInt32, count * width)
    index = lane // width
    place = dr.gather(mi.UInt32, rows, index) * width + lane % width
    if active is not True:
        active = dr.gather(mi.Bool, active, index)
    values = dr.gather(mi.Float, dr.detach(tensor).array, place, active=active)
    return mi.TensorXf(values, (count, *shape))


def owned_copy(values: Jit) -> Jit:
    """Return an evaluated copy of a Dr.Jit array, aligned even if the array is borrowed from NumPy
    (see `from_numpy`).

    The opaque 0 prevents its removal by the optimiser.
    """
    copy = dr.gather(
        type(values), values, dr.arange(mi.UInt32, dr.width(values)) + opaque(mi.UInt32, 0)
    )
    dr.eval(copy)
    return copy

"""Assertions that report where a comparison fails."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def assert_close(
    actual: Any,
    expected: Any,
    *,
    atol: float = 0.0,
    rtol: float = 0.0,
    where: Any = True,
    name: str = "",
) -> None:
    """Assert that no entry of `actual` differs from `expected` by more than `atol` + `rtol` max
    |expected|.

    Args:
        actual: NumPy array, or Dr.Jit array or tensor.
        expected: array of the same shape, or one number for all entries.
        atol: absolute tolerance.
        rtol: tolerance relative to the largest expected entry that is compared, not to each entry.
        where: mask of the entries that are compared, broadcast to their shape.
        name: of what is compared, for the message.

    Raises:
        AssertionError: the shapes differ, or an entry does, or is not finite; reports where the
            worst error is.
    """
    actual, expected = (
        np.asarray(dr.detach(v) if dr.is_array_v(v) else v) for v in (actual, expected)
    )
    label = f"{name}: " if name else ""
    expected = expected if expected.ndim else np.broadcast_to(expected, actual.shape)
    assert actual.shape == expected.shape, (
        f"{label}shape {list(actual.shape)}, expected {list(expected.shape)}"
    )
    if actual.dtype != np.longdouble and expected.dtype != np.longdouble:
        actual = np.asarray(actual, np.float64)
        expected = np.asarray(expected, np.float64)
    where = np.broadcast_to(where, actual.shape)
    error = np.where(where, np.abs(actual - expected), 0)
    bound = atol + rtol * float(np.abs(np.where(where, expected, 0)).max(initial=0))
    wrong = ~(error <= bound)
    if wrong.any():
        worst = tuple(
            int(i)
            for i in np.unravel_index(np.argmax(np.nan_to_num(error, nan=np.inf)), error.shape)
        )
        raise AssertionError(
            f"{label}off by {error[worst]:.3g} at {list(worst)} (found {actual[worst]:.9g}, "
            f"expected {expected[worst]:.9g}), bound {bound:.3g}; {wrong.sum()} of {where.sum()} "
            "entries exceed it"
        )

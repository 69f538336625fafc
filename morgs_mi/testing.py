"""For tests of code that renders Gaussians: tolerances with their reasons, a comparison, and a
fixture. It needs pytest.

Tolerances end in ``_ABS``, or in ``_REL`` where they are relative to the largest entry of an array.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

IMAGE_ABS = 2e-5
"""Colours, alpha, confidence, motion in px, and depth by the largest depth, of up to a thousand
Gaussians: the renderer works in float32 with a 2^p of relative error 3e-6 and sums some tens of
layers.
"""
STOPPED_IMAGE_ABS = 2e-4
"""The same for more Gaussians: a stop at transmittance 1e-4 hides at most that much of a colour of
1, per channel (colours reach 1.5), and neighbours of nearly equal depth change their order.
"""
GRADIENT_REL = 2e-4
"""Gradients add the rounding of sums over some hundred pixels."""
STOPPED_GRADIENT_REL = 2e-3
"""The same for more than a thousand Gaussians, of which some end below the stop on one machine and
above it on another.
"""
DUALITY_REL = 2e-4
"""Forward and reverse mode take different roundings of the same sums."""
CENTRAL_DIFFERENCE_REL = 2e-2
"""Central differences of a float32 image at the best step are good to the cube root of its
rounding.
"""
SUM_ORDER_REL = 1e-5
"""The same float32 terms summed in another order."""


@pytest.fixture(autouse=True)
def mitsuba_variant() -> Iterator[str]:
    """Activate a variant before each test and again after it, and return its name: the value of
    the environment variable ``MORGS_MI_TEST_VARIANT``, by default ``llvm_ad_rgb``.

    Import it in ``conftest.py``.
    """
    name = os.environ.get("MORGS_MI_TEST_VARIANT", "llvm_ad_rgb")
    mi.set_variant(name)
    yield name
    mi.set_variant(name)


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
    assert expected.shape in ((), actual.shape), (
        f"{name}: shape {list(actual.shape)}, expected {list(expected.shape)}"
    )
    where = np.broadcast_to(where, actual.shape)
    actual, expected = (np.where(where, v, 0) for v in (actual, expected))
    bound = atol + rtol * float(np.abs(expected).max(initial=0))
    np.testing.assert_allclose(actual, expected, 0, bound, equal_nan=False, err_msg=name)

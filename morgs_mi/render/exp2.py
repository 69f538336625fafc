"""The exponential of the blending loops."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Float

# Minimax over [-1/2, 1/2], highest power first: relative error 2.7e-6 in float32, like Taylor's
# fifth degree.
_EXP2 = (
    0.009570102207362652,
    0.05591786280274391,
    0.240247443318367,
    0.6931217908859253,
    0.9999992847442627,
)


def exp2(p: Float) -> Float:
    """Return 2^p for |p| < 126, relative error 3e-6; out of that range the result is undefined,
    without a trap.

    Adding 1.5 * 2^23 rounds to an integer in the low mantissa bits, which is then shifted into the
    exponent.
    """
    total = p + 12582912.0
    f = p - (total - 12582912.0)
    value = mi.Float(_EXP2[0])
    for coefficient in _EXP2[1:]:
        value = dr.fma(value, f, coefficient)
    exponent = dr.reinterpret_array(mi.Int32, total) << 23  # pyright: ignore[reportOperatorIssue]
    bits = dr.reinterpret_array(mi.Int32, value) + exponent
    return dr.reinterpret_array(mi.Float, bits)

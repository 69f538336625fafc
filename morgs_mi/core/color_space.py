"""The sRGB transfer functions (IEC 61966-2-1) in NumPy.

Colours that are splatted, optimised and compared are display-referred (encoded); linear light is at the boundaries: the
film, EXR files, the path tracer and colour correction. In traced code Mitsuba's own functions are used.
"""

from __future__ import annotations

import numpy as np

__all__ = ["SH_C0", "linear_to_srgb", "srgb_to_linear"]

SH_C0 = 0.28209479177387814
"""The spherical harmonic of degree 0: a colour is 0.5 + SH_C0 * coefficient."""


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB-encoded values, of any shape; values above 1 follow the same curve."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Return the sRGB-encoded values of linear light, of any shape; values above 1 follow the same curve."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)

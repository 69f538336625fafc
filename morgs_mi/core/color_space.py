"""The transfer curve between linear light and encoded colours, in NumPy and in Dr.Jit.

Colours that are splatted, optimised and compared are encoded; linear light is at the boundaries: the film, EXR files,
the path tracer and colour correction. Up to white, the curve is sRGB's (IEC 61966-2-1). Above, it is logarithmic, as
brightness is seen, with the slope that sRGB has at 1:

    encode(x) = sRGB(x)         for x <= 1
              = 1 + a ln(x)     for x > 1 ,    a = 1.055 / 2.4
    decode(y) = exp((y - 1) / a)    for y > 1

so 100 times white is 3.02. Below 0, the curve continues its linear part; NaN remains NaN.

An image is either uint8 in sRGB, or of floats; those of recordings are linear light, those of a fit are encoded.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = [
    "SH_C0",
    "TRANSFER",
    "decode_light",
    "decode_traced",
    "display_image",
    "display_stops",
    "encode_light",
    "encode_traced",
    "unit_values",
]

SH_C0 = 0.28209479177387814
"""The spherical harmonic of degree 0: a colour is 0.5 + SH_C0 * coefficient."""
TRANSFER = "srgb-log"
"""Name of the curve in the header of a stream with colours above white."""
# Slope of sRGB at 1.
_SLOPE = 1.055 / 2.4
# Percentile of the brightest channels of a recording that a display shows as white: lamps and highlights are fewer.
_WHITE_PERCENTILE = 99


def encode_light(linear: np.ndarray) -> np.ndarray:
    """Return the encoded values of linear light, of any shape."""
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)
    return np.where(linear > 1, 1 + _SLOPE * np.log(np.maximum(linear, 1)), srgb)


def decode_light(encoded: np.ndarray) -> np.ndarray:
    """Return the linear light of encoded values, of any shape."""
    srgb = np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4)
    return np.where(encoded > 1, np.exp((np.maximum(encoded, 1) - 1) / _SLOPE), srgb)


def encode_traced(linear: Any) -> Any:
    """Return `encode_light` of a Dr.Jit array, differentiable."""
    srgb = mi.math.linear_to_srgb(dr.select(linear > 1, 1, linear))
    return dr.select(linear > 1, 1 + _SLOPE * dr.log(dr.select(linear > 1, linear, 1)), srgb)


def decode_traced(encoded: Any) -> Any:
    """Return `decode_light` of a Dr.Jit array, differentiable."""
    srgb = mi.math.srgb_to_linear(dr.select(encoded > 1, 1, encoded))
    return dr.select(encoded > 1, dr.exp((dr.select(encoded > 1, encoded, 1) - 1) * (1 / _SLOPE)), srgb)


def unit_values(image: np.ndarray, dtype: type[np.floating[Any]] = np.float64) -> np.ndarray:
    """Return encoded values of an image as floats, white being 1: uint8 is divided by 255, floats are such values."""
    return image.astype(dtype) / 255 if image.dtype == np.uint8 else image.astype(dtype)


def display_image(image: np.ndarray, stops: float = 0.0) -> np.ndarray:
    """Return an image as a display shows it, uint8 [H, W, 3].

    Args:
        image: linear light [H, W, 3], brightened by 2^stops and clipped at white; uint8 is returned as it is.
        stops: display exposure.
    """
    if image.dtype == np.uint8:
        return image
    return np.rint(255 * encode_light(np.clip(image * np.float32(2**stops), 0, 1))).astype(np.uint8)


def display_stops(images: Any) -> float:
    """Return the display exposure of a recording in stops, which shows nearly all of its first images up to white.

    Args:
        images: of the first frame, an iterable of [H, W, 3]; None is skipped. With no linear light above 1, the
            exposure is 0.
    """
    brightest = [image.max(axis=-1).ravel() for image in images if image is not None and image.dtype != np.uint8]
    if not brightest or max(each.max() for each in brightest) <= 1:
        return 0.0
    white = float(np.percentile(np.concatenate(brightest), _WHITE_PERCENTILE))
    return -float(np.log2(white)) if white > 0 else 0.0

"""The transfer curve between linear light and encoded colours, in NumPy and in Dr.Jit.

Colours that are splatted, optimised and compared are encoded; linear light is at the boundaries:
the film, EXR files, the path tracer and colour correction. Up to white, the curve is sRGB's (IEC
61966-2-1). Above, it is logarithmic, as brightness is seen, with the slope that sRGB has at 1:

    encode(x) = sRGB(x)         for x <= 1
              = 1 + a ln(x)     for x > 1 ,    a = 1.055 / 2.4
    decode(y) = exp((y - 1) / a)    for y > 1

so 100 times white is 3.02. Below 0, the curve continues its linear part; NaN remains NaN.

An image has uint8 values in sRGB, or floats. Floats of a recording are linear light; floats of a
fit are encoded.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.types import Color3f

_LOG = logging.getLogger(__name__)

SH_C0 = 0.28209479177387814
"""The spherical harmonic of degree 0: a colour is 0.5 + SH_C0 * coefficient."""
TRANSFER = "srgb-log"
"""Name of the curve in the header of a stream with colours above white."""
BRIGHTEST_LIGHT = 1e30
"""Linear light that no image exceeds: sums and squares of its encoded values stay far from the
limits of float32.
"""
BRIGHTEST = 32.0
"""Encoded value that no image exceeds; `BRIGHTEST_LIGHT` is encoded as 31.4."""
# Slope of sRGB at 1.
_SLOPE = 1.055 / 2.4
# Percentile of the brightest channels of a recording that a display shows as white: lamps and
# highlights are fewer.
_WHITE_PERCENTILE = 99


def encode_light(linear: np.ndarray) -> np.ndarray:
    """Return the encoded values of linear light, of any shape."""
    srgb = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055
    )
    return np.where(linear > 1, 1 + _SLOPE * np.log(np.maximum(linear, 1)), srgb)


def decode_light(encoded: np.ndarray) -> np.ndarray:
    """Return the linear light of encoded values, of any shape."""
    srgb = np.where(
        encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4
    )
    return np.where(encoded > 1, np.exp((np.maximum(encoded, 1) - 1) / _SLOPE), srgb)


def encode_traced(linear: Color3f) -> Color3f:
    """Return `encode_light` of a Dr.Jit array, differentiable."""
    srgb = mi.math.linear_to_srgb(dr.select(linear > 1, 1, linear))
    return dr.select(linear > 1, 1 + _SLOPE * dr.log(dr.select(linear > 1, linear, 1)), srgb)


def decode_traced(encoded: Color3f) -> Color3f:
    """Return `decode_light` of a Dr.Jit array, differentiable."""
    srgb = mi.math.srgb_to_linear(dr.select(encoded > 1, 1, encoded))
    return dr.select(
        encoded > 1, dr.exp((dr.select(encoded > 1, encoded, 1) - 1) * (1 / _SLOPE)), srgb
    )


def unit_values(image: np.ndarray, dtype: type[np.floating] = np.float64) -> np.ndarray:
    """Return encoded values of an image as floats, white being 1: uint8 is divided by 255, floats
    are such values.
    """
    return image.astype(dtype) / 255 if image.dtype == np.uint8 else image.astype(dtype)


def byte_values(image: np.ndarray) -> np.ndarray:
    """Return encoded values of an image as uint8, 255 being white; floats are clipped to [0, 1]."""
    if image.dtype == np.uint8:
        return image
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def positive_light(light: np.ndarray, place: str) -> np.ndarray:
    """Return a copy of linear light [H, W, 3] as float32 with 0 for negative values, which are
    warned of once.

    Raises:
        ValueError: a value is not finite, or above `BRIGHTEST_LIGHT`; `place` is where the sentence
            begins.
    """
    least = float(light.min())
    most = float(light.max())
    if not -BRIGHTEST_LIGHT <= least <= most <= BRIGHTEST_LIGHT:
        raise ValueError(
            f"{place} must be finite and at most {BRIGHTEST_LIGHT:g}, got linear light from "
            f"{least:g} to {most:g}; replace such pixels."
        )
    if least < 0:
        _warn_about_negative_light()
    return np.maximum(light, 0, dtype=np.float32)


@cache
def _warn_about_negative_light() -> None:
    _LOG.warning("Images in linear light have negative values, which are set to 0.")


def exposed(encoded: np.ndarray, stops: float) -> np.ndarray:
    """Return encoded values, brightened by stops of linear light; not clipped."""
    return encode_light(np.float32(2**stops) * decode_light(encoded)) if stops else encoded


def display_image(image: np.ndarray, stops: float = 0.0) -> np.ndarray:
    """Return linear light [H, W, 3], brightened by stops and clipped at white, as uint8, and uint8
    as it is.
    """
    if image.dtype == np.uint8:
        return image
    return np.rint(255 * encode_light(np.clip(image * np.float32(2**stops), 0, 1))).astype(np.uint8)


def display_stops(images: Iterable[np.ndarray | None]) -> float:
    """Return the display exposure in stops by which the 99th percentile of images [H, W, 3] or None
    becomes white.

    It is 0 without linear light above 1.
    """
    light = [image for image in images if image is not None and image.dtype != np.uint8]
    brightest = np.concatenate([np.zeros(0, np.float32), *(np.ravel(x.max(-1)) for x in light)])
    if brightest.max(initial=0) <= 1:
        return 0.0
    white = float(np.percentile(brightest, _WHITE_PERCENTILE))
    return -float(np.log2(white)) if white > 0 else 0.0

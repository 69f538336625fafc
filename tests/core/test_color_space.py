"""The transfer curve: closed form, inverse, slope and extremes, in NumPy and in Dr.Jit."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.core.color_space import (
    decode_light,
    decode_traced,
    display_image,
    display_stops,
    encode_light,
    encode_traced,
)

A = 1.055 / 2.4
LIGHT = np.concatenate([np.linspace(-0.1, 1, 111), np.geomspace(1, 1e20, 41)])


def test_encode_light__is_srgb_up_to_white_and_logarithmic_above():
    x = np.linspace(0, 1, 4097).astype(np.float32)
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0) ** (1 / 2.4) - 0.055)
    assert_array_equal(encode_light(x), srgb)
    assert_allclose(
        encode_light(np.array([100.0, 1e20])), [1 + A * np.log(100), 1 + A * np.log(1e20)]
    )
    assert abs(encode_light(np.array(100.0)) - 3.02) < 0.01


def test_decode_light__inverts_encode_light():
    # sRGB's two pieces meet to within 1e-8 only, and its decoding is rounded likewise.
    assert_allclose(decode_light(encode_light(LIGHT)), LIGHT, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("traced", "curve"), [(encode_traced, encode_light), (decode_traced, decode_light)]
)
def test_encode_traced__agrees_with_numpy_in_value_and_slope(traced, curve):
    x = np.float32([-0.1, 0, 0.001, 0.2, 0.99, 1.01, 3, 15])
    values = mi.Float(x)
    dr.enable_grad(values)
    result = traced(values)
    dr.forward(values)
    assert_allclose(result.numpy(), curve(x.astype(float)), rtol=2e-5, atol=1e-7)
    h = 1e-6
    slope = (curve(x.astype(float) + h) - curve(x.astype(float) - h)) / (2 * h)
    assert_allclose(dr.grad(result).numpy(), slope, rtol=2e-5)
    white = mi.Float(1)
    dr.enable_grad(white)
    result = traced(white)
    dr.forward(white)
    assert dr.grad(result)[0] == pytest.approx(A if traced is encode_traced else 1 / A, rel=1e-4)


def test_display_image__brightens_by_stops_and_clips():
    light = np.float32([[[0.25, 0.5, 8]]])
    assert_array_equal(display_image(light, 1), [[[188, 255, 255]]])
    grey = np.uint8([[[7, 8, 9]]])
    assert display_image(grey, 3) is grey


def test_display_stops__shows_the_99th_percentile_as_white():
    image = np.full((100, 100, 3), 4, np.float32)
    image[:1, :50] = 1000
    assert display_stops([None, image]) == -2
    assert display_stops([image / 1000]) == 0
    assert display_stops([np.zeros((2, 2, 3), np.uint8)]) == 0

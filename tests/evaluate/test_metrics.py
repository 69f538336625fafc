"""Metrics compared with their definitions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.evaluate.metrics import (
    delta_e_map,
    endpoint_error,
    iou,
    mean_over,
    psnr,
    psnr_mu,
    ssim_map,
)
from tests.reference import ssim_by_windows

rng = np.random.default_rng(0)
TRUTH = rng.random((24, 31, 3))
NOISY = np.clip(TRUTH + rng.normal(0, 0.1, TRUTH.shape), 0, 1)


def test_psnr__of_a_known_error():
    assert psnr(TRUTH + 0.1, TRUTH) == pytest.approx(20)
    assert psnr(TRUTH, TRUTH) == float("inf")
    black = np.zeros((4, 4, 3), np.uint8)
    assert psnr(black + np.uint8(255), black) == pytest.approx(0)


def test_psnr__counts_the_masked_pixels_only():
    image = TRUTH.copy()
    image[:12] += 0.1
    mask = np.zeros(TRUTH.shape[:2], bool)
    mask[:12] = True
    assert psnr(image, TRUTH, mask) == pytest.approx(20)
    assert psnr(image, TRUTH, ~mask) == float("inf")
    assert np.isnan(psnr(image, TRUTH, mask & ~mask))


def test_ssim_map__equals_its_definition():
    maps = np.stack([ssim_by_windows(NOISY[..., c], TRUTH[..., c]) for c in range(3)], -1)
    assert_allclose(ssim_map(NOISY, TRUTH), maps.mean(-1), atol=1e-12)
    assert_allclose(ssim_map(NOISY[..., 0], TRUTH[..., 0]), maps[..., 0], atol=1e-12)


def test_psnr_ssim_and_delta_e_map__bytes_and_floats_agree():
    a, b = ((x * 255 + 0.5).astype(np.uint8) for x in (NOISY, TRUTH))
    assert psnr(a, b) == pytest.approx(psnr(a / 255, b / 255))
    assert_allclose(ssim_map(a, b), ssim_map(a / 255, b / 255))
    assert_allclose(delta_e_map(a, b), delta_e_map(a / 255, b / 255))


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((255, 0, 0), (0, 0, 255), 52.88),
        ((255, 0, 0), (0, 255, 0), 86.61),
        ((0, 0, 0), (255, 255, 255), 100),
        ((9, 99, 199), (9, 99, 199), 0),
    ],
)
def test_delta_e_map__of_the_corners_of_the_gamut(a, b, expected):
    """Values that calculators of CIE dE2000 agree on for sRGB, to their two digits."""
    result = delta_e_map(np.full((1, 1, 3), a, np.uint8), np.full((1, 1, 3), b, np.uint8))
    assert result == pytest.approx(expected, abs=0.005)


def test_delta_e_map__is_per_pixel():
    truth = np.tile(TRUTH, (2, 1, 1))  # more rows than are compared at once
    image = truth.copy()
    image[37, 5] = 1 - image[37, 5]
    error = delta_e_map(image, truth)
    assert error.shape == (48, 31)
    assert np.argwhere(error).tolist() == [[37, 5]]


def test_endpoint_error__is_a_mean_length():
    truth = rng.normal(0, 3, (6, 7, 2))
    assert endpoint_error(truth + np.array([3, 4]), truth) == pytest.approx(5)
    motion = truth.copy()
    motion[0] += (0, 2)
    mask = np.zeros((6, 7), bool)
    mask[:2] = True
    assert endpoint_error(motion, truth, mask) == pytest.approx(1)


def test_iou__of_known_masks():
    a, b = np.zeros((2, 4, 5), bool)
    a[0] = True
    b[:, 0] = True
    assert iou(a, b) == pytest.approx(1 / 8)
    assert iou(a, a) == 1
    assert iou(a, ~a) == 0
    assert np.isnan(iou(a & ~a, b & ~b))


def test_mean_over__centres_a_smaller_map_in_the_mask():
    mask = np.zeros((6, 7), bool)
    mask[2, 3] = True
    values = np.arange(12.0).reshape(4, 3)  # its pixel (1, 1) is the mask's (2, 3)
    assert mean_over(values, mask) == values[1, 1]
    assert np.isnan(mean_over(values, mask & ~mask))
    assert np.isnan(mean_over(np.array([1, np.nan]))), "a map with NaN has no mean"
    assert ssim_map(NOISY, TRUTH).shape == (14, 21)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: psnr(TRUTH, TRUTH[:5]), r"psnr\(\): .* \(5, 31, 3\)"),
        (lambda: psnr(TRUTH, TRUTH, np.ones((24, 31))), "must be bool .* float64"),
    ],
)
def test_metrics__refuse_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_psnr_mu__is_the_psnr_of_the_mu_law_relative_to_the_brightest_true_value():
    truth = np.full((4, 4, 3), 20.0)
    truth[0] = 0
    assert psnr_mu(truth, truth) == np.inf
    light = np.where(truth > 0, 10.0, 0.0)
    error = 1 - np.log1p(2500) / np.log1p(5000)
    assert psnr_mu(light, truth) == pytest.approx(-10 * np.log10(0.75 * error**2))
    assert psnr_mu(1000 * light, truth) == np.inf, "values above the brightest true one are clipped"
    assert psnr_mu(light, truth, np.arange(16).reshape(4, 4) < 4) == np.inf

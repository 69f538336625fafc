"""Detail and noise of images, from which the number of Gaussians of the first frame follows.

An image is averaged over blocks of 2x2 pixels, again and again. A value that differs from the mean
of its block by more than a threshold and the noise is a detail. Flat areas and noise have none,
edges have some at every level. Details that several views see are counted once: the number of
details of all views is divided by the mean number of views that see a point.

Noise: the difference of two Laplacians is zero on gradients and edges, and has unit gain for noise
(Immerkaer 1996). Fine texture passes it, too. But a mean over 2x2 pixels halves white noise, while
natural texture, which has contrast in every octave, keeps its strength: with s and s' the responses
at the full and at half the size,

    n^2 = 4/3 (s^2 - s'^2) ,    0 where that is negative,

is the variance of white noise where there is nothing else, and no more than that where there is.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from morgs_mi.core.color_space import unit_values
from morgs_mi.platform.checks import valid_pixels

# A value of a block follows from its mean and the other three.
_INDEPENDENT = 3 / 4
# Difference from the mean of a block, relative to white, from which a value is a detail.
_THRESHOLD = 0.02
# The same in standard deviations of the noise.
_NOISE = 3.5

_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
# Of normal noise, median absolute value relative to the standard deviation.
_MEDIAN = 0.6745
# White noise from which images are noisy.
_NOISY = 0.015


def count_details(image: np.ndarray, mask: np.ndarray | None) -> float:
    """Return the number of details of an image.

    Args:
        image: [H, W, 3], uint8 or encoded floats.
        mask: valid pixels [H, W], or None; a block with others has no detail.
    """
    values = unit_values(image, np.float32)
    valid = valid_pixels(mask, image.shape).astype(np.float32)
    noise = _NOISE * noise_of(image)
    count = 0
    while min(values.shape[:2]) > 1:
        means = block_means(values)
        fractions = block_means(valid)
        pixel_means = _pixels_of_blocks(means)
        is_valid = _pixels_of_blocks(fractions == 1)
        height, width = is_valid.shape
        differences = np.abs(values[:height, :width] - pixel_means).max(axis=-1)
        count += np.count_nonzero((differences > max(_THRESHOLD, noise)) & is_valid)
        values = means
        valid = fractions
        noise = noise / 2
    return _INDEPENDENT * count


def is_noisy(images: Sequence[np.ndarray]) -> bool:
    """Return whether images [H, W, 3], uint8 or encoded floats, have much white noise."""
    return bool(np.mean([white_noise_of(image) for image in images]) >= _NOISY)


def noise_of(image: np.ndarray) -> float:
    """Return the standard deviation of noise and fine texture in most of an image [H, W, 3],
    relative to white.

    Args:
        image: uint8 or encoded floats.
    """
    response = cv2.filter2D(unit_values(image, np.float32), -1, _FILTER)
    return float(np.median(np.abs(response))) / _MEDIAN


def white_noise_of(image: np.ndarray) -> float:
    """Return the standard deviation of the white noise of an image [H, W, 3], uint8 or floats,
    relative to white.
    """
    if min(image.shape[:2]) < 2:
        return 0.0
    half = block_means(image.astype(np.float32))
    half = half / 255 if image.dtype == np.uint8 else half
    return float(np.sqrt(max(4 / 3 * (noise_of(image) ** 2 - noise_of(half) ** 2), 0)))


def block_means(values: np.ndarray) -> np.ndarray:
    """Return the means of the blocks of 2x2 pixels of an image, without the last row or column
    where their number is odd.
    """
    height = values.shape[0] // 2
    width = values.shape[1] // 2
    whole = values[: 2 * height, : 2 * width]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _pixels_of_blocks(values: np.ndarray) -> np.ndarray:
    """Return the values of blocks of 2x2 pixels at each of their pixels."""
    return values.repeat(2, axis=0).repeat(2, axis=1)

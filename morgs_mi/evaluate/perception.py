"""Perceived difference of two images: maps of FLIP and of the colour difference dE2000, one value per pixel.

Images are display-referred RGB [H, W, 3], sRGB-encoded, float in [0, 1] or uint8. FLIP's constants are from
Andersson, Nilsson, Akenine-Moller, Oskarsson, Astrom and Fairchild, "FLIP: a difference evaluator for alternating
images", HPG 2020: the image is filtered by the eye's contrast sensitivity, colours are compared by HyAB in
Hunt-adjusted CIELAB, and differing edges or points increase the error.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from morgs_mi.core.color_space import srgb_to_linear
from morgs_mi.core.threads import map_in_threads
from morgs_mi.evaluate.metrics import unit_pair

__all__ = ["PIXELS_PER_DEGREE", "delta_e_map", "flip_map"]

# FLIP's own default: 0.7 m from a 4K monitor 0.7 m wide.
PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * np.pi / 180

# Linear sRGB to CIE XYZ as exact fractions; the rows sum to the white point, D65.
_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_WHITE = _XYZ.sum(1)
# Contrast sensitivity per channel: amplitudes and widths (degrees squared) of two Gaussians; luminance, red-green,
# blue-yellow.
_SENSITIVITY = (((1, 0.0047), (0, 1e-5)), ((1, 0.0053), (0, 1e-5)), ((34.1, 0.04), (13.5, 0.025)))
_COLOUR_EXPONENT, _FEATURE_EXPONENT = 0.7, 0.5
# Colour errors up to 0.4 of the largest take 0.95 of the range.
_KNEE, _KNEE_VALUE = 0.4, 0.95
_FEATURE_WIDTH = 0.082  # degrees
_ROWS = 32


def flip_map(image: np.ndarray, truth: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> np.ndarray:
    """Return LDR-FLIP per pixel [H, W], in [0, 1]; 0 where no difference is visible. Its mean is the FLIP value.

    Args:
        image: [H, W, 3].
        truth: likewise; FLIP is symmetric.
        pixels_per_degree: pixels per degree of the observer's field of view.

    Raises:
        ValueError: the sizes differ, an image does not have three channels, or `pixels_per_degree` is not positive.
    """
    _check_rgb("flip_map", image, truth)
    if not (np.isfinite(pixels_per_degree) and pixels_per_degree > 0):
        raise ValueError(f"flip_map(): `pixels_per_degree` must be positive, got {pixels_per_degree}.")
    pair = [_opponent(srgb_to_linear(np.clip(each, 0, 1))) for each in unit_pair("flip_map", image, truth)]
    colour = _colour_error(*(_hunt_lab(_filtered(each, pixels_per_degree)) for each in pair))
    features = [_features((each[..., 0] + 16) / 116, pixels_per_degree) for each in pair]
    # Strengths of edges and of points; the larger difference counts.
    structure = np.max([np.abs(a - b) for a, b in zip(*features, strict=True)], axis=0)
    return colour ** (1 - (structure / np.sqrt(2)) ** _FEATURE_EXPONENT)


def delta_e_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the colour difference CIE dE2000 per pixel [H, W], by colour-science; a value of about 1 is just visible.

    Colours are decoded from sRGB and compared under its white point, D65. Values outside [0, 1] are clipped, as on
    a display.

    Args:
        image: [H, W, 3].
        truth: likewise.

    Raises:
        ValueError: the sizes differ or an image does not have three channels.
    """
    # The import takes a second, for which other commands should not wait.
    from colour import XYZ_to_Lab
    from colour.difference import delta_E_CIE2000
    from colour.models import RGB_COLOURSPACE_sRGB

    _check_rgb("delta_e_map", image, truth)
    a, b = (np.clip(each, 0, 1) for each in unit_pair("delta_e_map", image, truth))

    def lab(colours: np.ndarray) -> np.ndarray:
        xyz = srgb_to_linear(colours) @ RGB_COLOURSPACE_sRGB.matrix_RGB_to_XYZ.T
        return XYZ_to_Lab(xyz, RGB_COLOURSPACE_sRGB.whitepoint)

    def rows(start: int) -> np.ndarray:
        band = slice(start, start + _ROWS)
        return delta_E_CIE2000(lab(a[band]), lab(b[band]))

    # The temporaries of a whole image exceed the cache, and NumPy alone uses one core.
    return np.concatenate(map_in_threads(rows, range(0, len(a), _ROWS)))


def _colour_error(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the HyAB distance of Hunt-adjusted colours [H, W], compressed and scaled to [0, 1]."""
    error, largest = _hyab(a, b) ** _COLOUR_EXPONENT, _largest_error()
    knee = _KNEE * largest
    above = _KNEE_VALUE + (error - knee) / (largest - knee) * (1 - _KNEE_VALUE)
    return np.where(error < knee, error * (_KNEE_VALUE / knee), above)


@cache
def _largest_error() -> float:
    """Return the error between green and blue, the colours of the gamut that are farthest apart."""
    green, blue = (_hunt_lab(np.eye(3)[i]) for i in (1, 2))
    return float(_hyab(green, blue) ** _COLOUR_EXPONENT)


def _hyab(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    difference = a - b
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])


def _filtered(opponent: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    """Return opponent colours, blurred by the eye's contrast sensitivity, as linear RGB [H, W, 3] in [0, 1]."""
    widest = max(width for pair in _SENSITIVITY for _, width in pair)
    radius = int(np.ceil(3 * np.sqrt(widest / (2 * np.pi**2)) * pixels_per_degree))
    squared = (np.arange(-radius, radius + 1) / pixels_per_degree) ** 2
    channels = []
    for plane, gaussians in zip(np.moveaxis(opponent, -1, 0), _SENSITIVITY, strict=True):
        blurred, total = np.zeros_like(plane), 0.0
        for amplitude, width in gaussians:
            kernel = np.exp(-(np.pi**2) * squared / width)
            weight = amplitude * np.sqrt(np.pi / width)
            if weight:
                blurred += weight * _separable(plane, kernel, kernel)
                total += weight * kernel.sum() ** 2
        channels.append(blurred / total)
    return np.clip(_linear_of_opponent(np.stack(channels, -1)), 0, 1)


def _features(luminance: np.ndarray, pixels_per_degree: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the strength of edges and of points of a plane [H, W]: first and second Gaussian derivatives."""
    sigma = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    radius = int(np.ceil(3 * sigma))
    x = np.arange(-radius, radius + 1)
    gaussian = np.exp(-(x**2) / (2 * sigma**2))
    smooth = gaussian / gaussian.sum()

    def strength(kernel: np.ndarray) -> np.ndarray:
        # The weights of each sign sum to one, hence the strength lies in [0, 1].
        kernel = kernel / np.where(kernel > 0, kernel[kernel > 0].sum(), -kernel[kernel < 0].sum())
        return np.hypot(_separable(luminance, kernel, smooth), _separable(luminance, smooth, kernel))

    return strength(-x * gaussian), strength((x**2 / sigma**2 - 1) * gaussian)


def _separable(plane: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(plane, cv2.CV_64F, across, down, borderType=cv2.BORDER_REPLICATE)


def _opponent(linear: np.ndarray) -> np.ndarray:
    """Return linear RGB as YyCxCz: CIELAB without its cube roots."""
    x, y, z = np.moveaxis(linear @ (_XYZ / _WHITE[:, None]).T, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def _linear_of_opponent(opponent: np.ndarray) -> np.ndarray:
    y = (opponent[..., 0] + 16) / 116
    xyz = np.stack([y + opponent[..., 1] / 500, y, y - opponent[..., 2] / 200], -1) * _WHITE
    return xyz @ np.linalg.inv(_XYZ).T


def _hunt_lab(linear: np.ndarray) -> np.ndarray:
    """Return linear RGB as CIELAB with chroma scaled by lightness, because dark colours look less colourful."""
    ratio = linear @ (_XYZ / _WHITE[:, None]).T
    limit = 6 / 29
    root = np.where(ratio > limit**3, np.cbrt(ratio), ratio / (3 * limit**2) + 4 / 29)
    x, y, z = np.moveaxis(root, -1, 0)
    lightness = 116 * y - 16
    return np.stack([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)], -1)


def _check_rgb(name: str, image: np.ndarray, truth: np.ndarray) -> None:
    for each in (image, truth):
        if np.ndim(each) != 3 or np.shape(each)[2] != 3:
            raise ValueError(f"{name}(): images must be [H, W, 3], got {np.shape(each)}.")

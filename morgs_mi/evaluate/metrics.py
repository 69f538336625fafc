"""How far a picture or a motion is from the truth. NumPy, float64, so that every back-end is judged alike.

Pictures are display-referred RGB (or one channel), float in [0, 1] or uint8.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import correlate1d

__all__ = ["endpoint_error", "psnr", "ssim"]

# Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment", TIP 2004.
WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return 10 log10(1 / mean squared error) in dB; infinite where the two are equal.

    Args:
        image: [H, W, 3] or [H, W].
        truth: likewise.
        mask: [H, W] bool, the pixels that count; without any, the result is NaN.

    Raises:
        ValueError: the sizes differ.
    """
    image, truth = _pair("psnr", image, truth, mask)
    squared = np.square(image - truth)
    error = _mean(squared if mask is None else squared[mask])
    return float(-10 * np.log10(error)) if error != 0 else float("inf")


def ssim(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean structural similarity, in [-1, 1] and 1 for equal pictures (Wang et al. 2004).

    The window is an 11x11 Gaussian of sigma 1.5, moments are the population's, and only windows that lie
    wholly inside the picture count. Channels are averaged.

    Args:
        image: [H, W, 3] or [H, W], both sides at least 11 pixels.
        truth: likewise.
        mask: [H, W] bool, the window centres that count; without any, the result is NaN.

    Raises:
        ValueError: the sizes differ or are smaller than the window.
    """
    image, truth = _pair("ssim", image, truth, mask)
    if min(image.shape[:2]) < WINDOW:
        raise ValueError(f"ssim(): pictures must be at least {WINDOW}x{WINDOW} pixels, got {image.shape[:2]}.")
    x, y = _blur(image), _blur(truth)
    var_x, var_y = _blur(image**2) - x**2, _blur(truth**2) - y**2
    covariance = _blur(image * truth) - x * y
    similarity = (2 * x * y + C1) * (2 * covariance + C2) / ((x**2 + y**2 + C1) * (var_x + var_y + C2))
    half = WINDOW // 2
    return _mean(similarity if mask is None else similarity[mask[half:-half, half:-half]])


def endpoint_error(motion: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean length of motion - truth in pixels.

    Args:
        motion: [H, W, 2] in pixels.
        truth: likewise, of the same sign and on the same grid.
        mask: [H, W] bool, the pixels that count; without any, the result is NaN.

    Raises:
        ValueError: the sizes differ or the last axis is not 2.
    """
    if motion.ndim != 3 or motion.shape[2] != 2:
        raise ValueError(f"endpoint_error(): `motion` must be [H, W, 2], got {motion.shape}.")
    _check("endpoint_error", motion, truth, mask)
    error = np.linalg.norm(np.asarray(motion, np.float64) - truth, axis=-1)
    return _mean(error if mask is None else error[mask])


def _blur(image: np.ndarray) -> np.ndarray:
    """Average over the Gaussian window wherever it fits, [H - 10, W - 10, ...]."""
    half = WINDOW // 2
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / SIGMA) ** 2)
    weights /= weights.sum()
    rows = correlate1d(image, weights, axis=0)[half:-half]
    return correlate1d(rows, weights, axis=1)[:, half:-half]


def _pair(name: str, image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    _check(name, image, truth, mask)
    return _unit(image), _unit(truth)


def _check(name: str, image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> None:
    if np.shape(image) != np.shape(truth):
        raise ValueError(
            f"{name}(): both must have one size, got {np.shape(image)} and {np.shape(truth)}; resize one first."
        )
    if mask is not None and (mask.shape != np.shape(image)[:2] or mask.dtype != bool):
        raise ValueError(f"{name}(): `mask` must be bool {np.shape(image)[:2]}, got {mask.dtype} {mask.shape}.")


def _unit(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")

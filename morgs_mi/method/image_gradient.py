"""Derivatives of images, and their products per Gaussian: the sums of Lucas and Kanade's method
(IJCAI 1981).
"""

from __future__ import annotations

import cv2
import numpy as np

from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.view_group import backproject


def blurred(image: np.ndarray, blur: float) -> np.ndarray:
    """Return an image [H, W, C] after a Gaussian filter of standard deviation `blur` in pixels; 0:
    as it is.
    """
    return cv2.GaussianBlur(image, (0, 0), blur) if blur else image


def image_gradient(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of a float32 image [H, W, C] by x and y, per px (Sobel's filter)."""
    x, y = (
        cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1))
    )
    return np.asarray(x), np.asarray(y)


def gradient_products(
    gaussians: ActivatedGaussians,
    view: ActiveView,
    error: np.ndarray,
    gradient: tuple[np.ndarray, np.ndarray],
    weight: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums of w g g^T [N, 2, 2] and of w e g [N, 2] over the pixels and colours of a
    view, per Gaussian.

    Args:
        gaussians: N Gaussians; their blend weights weight the pixels.
        view: the whole view.
        error: e [H, W, 3].
        gradient: g, the derivatives [H, W, 3] along x and y, per px.
        weight: w [H, W], a further weight of the pixels.
    """
    x, y = gradient
    sums = [
        weight * np.sum(a * b, axis=-1) for a, b in ((x, x), (x, y), (y, y), (error, x), (error, y))
    ]
    sums = backproject(gaussians, view, np.stack(sums, axis=-1)).astype(np.float64)
    return sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2), sums[:, 3:]

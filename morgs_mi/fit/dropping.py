"""Random dropping of Gaussians, which improves novel views (DropGaussian, Park et al. 2025).

Where training views are few or noisy, Gaussians overfit them together: one compensates for another in a single view. In
every step of the first frame, each Gaussian is left out with probability p, and the opacities of the others are scaled
by 1 / (1 - p). Cross-validation chooses p (see `cross_validation`), or, of few views, the noise of their images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.attributes import sigmoid
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy

__all__ = ["dropped", "dropping_by_noise", "noise_of"]

# Logit of an opacity that no cut-off of the renderer lets pass, and the largest opacity.
_INVISIBLE, _MOST = -30.0, 0.999
# Noise from which few views are fitted with dropping, standard deviation relative to white, and its probability.
_NOISY, _NOISY_DROPPING = 0.015, 0.2
# The difference of two Laplacians, which is zero on gradients and edges, with unit gain for noise (Immerkaer 1996).
_NOISE_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6


def dropped(gaussians: Gaussians, probability: float, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians as one step of the first frame renders them, differentiable.

    Args:
        gaussians: N Gaussians.
        probability: with which each is left out, below 1; 0: none is.
        rng: draws which.
    """
    if not probability:
        return gaussians
    kept = from_numpy(mi.UInt32, rng.random(len(gaussians), np.float32) >= probability) != 0
    opacity = dr.minimum(sigmoid(gaussians.logit_opacities.array) * dr.opaque(mi.Float, 1 / (1 - probability)), _MOST)
    logits = dr.select(kept, dr.log(opacity) - dr.log(1 - opacity), _INVISIBLE)
    return replace(gaussians, logit_opacities=mi.TensorXf(logits))


def dropping_by_noise(images: Sequence[np.ndarray]) -> float:
    """Return the probability of dropping for views that are too few for cross-validation, from their noise.

    Args:
        images: [H, W, 3], uint8.
    """
    return _NOISY_DROPPING if np.mean([noise_of(image) for image in images]) >= _NOISY else 0.0


def noise_of(image: np.ndarray) -> float:
    """Return the standard deviation of an image's noise relative to white; texture on less than half does not count."""
    filtered = cv2.filter2D(image.astype(np.float32) / 255, -1, _NOISE_FILTER)
    return float(np.median(np.abs(filtered)) / 0.6745)

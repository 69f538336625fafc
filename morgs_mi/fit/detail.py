"""The number of Gaussians of the first frame, from the detail of its images.

An image is averaged over blocks of 2x2 pixels, again and again. A value that differs from the mean
of its block by more than a threshold and the noise is a detail. Flat areas and noise have none,
edges have some at every level. Details that several views see are counted once: the number of
details of all views is divided by the mean number of views that see a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from morgs_mi.core.color_space import unit_values
from morgs_mi.core.rig import mean_views
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.noise import block_means, noise_of
from morgs_mi.fit.view import View

# A value of a block follows from its mean and the other three.
_INDEPENDENT = 3 / 4
# Difference from the mean of a block, relative to white, from which a value is a detail.
_THRESHOLD = 0.02
# The same in standard deviations of the noise.
_NOISE = 3.5


def with_num_gaussians(config: FitConfig, views: Sequence[View], points: np.ndarray) -> FitConfig:
    """Return the settings of a first frame with a number of Gaussians, which follows from the views
    if none is given.

    Args:
        config: settings of the fit.
        views: V views.
        points: [P, 3] of the scene, world units, or none.
    """
    if config.num_gaussians is not None:
        return config
    how = config.detail
    details = sum(count_details(view.image, view.mask) for view in views)
    count = how.per_detail * details / mean_views([view.camera for view in views], points)
    return replace(
        config, num_gaussians=int(np.clip(round(count), how.least_gaussians, how.most_gaussians))
    )


def count_details(image: np.ndarray, mask: np.ndarray | None) -> float:
    """Return the number of details of an image.

    Args:
        image: [H, W, 3], uint8 or encoded floats.
        mask: valid pixels [H, W], or None; a block with others has no detail.
    """
    values = unit_values(image, np.float32)
    valid = np.ones(image.shape[:2], np.float32) if mask is None else mask.astype(np.float32)
    noise = _NOISE * noise_of(image)
    count = 0
    while min(values.shape[:2]) > 1:
        means = block_means(values)
        fractions = block_means(valid)
        # At each pixel of the blocks.
        pixel_means, is_valid = (
            v.repeat(2, axis=0).repeat(2, axis=1) for v in (means, fractions == 1)
        )
        height, width = is_valid.shape
        differences = np.abs(values[:height, :width] - pixel_means).max(axis=-1)
        is_detail = (differences > max(_THRESHOLD, noise)) & is_valid
        count += np.count_nonzero(is_detail)
        values = means
        valid = fractions
        noise = noise / 2
    return _INDEPENDENT * count

"""Cropping: which Gaussians are shown."""

from __future__ import annotations

from itertools import product

import numpy as np

from morgs_mi.core.gaussians import Gaussians

__all__ = ["box_edges", "crop_limits", "is_in_box", "is_shown"]

# Share of the means beyond each face of the crop box: far Gaussians of the background would make it useless.
_BEYOND = 0.005


def crop_limits(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [2, 3] of the largest crop box, which contains nearly all means [N, 3], and the steps [3].

    The step is a power of ten, at most a hundredth of the box, and the corners are multiples of it.
    """
    low, high = np.quantile(means, (_BEYOND, 1 - _BEYOND), axis=0)
    step = 10.0 ** np.floor(np.log10(np.maximum(high - low, 1e-6) / 100))
    return np.stack([np.floor(low / step), np.floor(high / step) + 1]) * step, step


def is_in_box(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return the mask [N] of the points [N, 3] in a box with corners [2, 3]."""
    return ((points >= box[0]) & (points <= box[1])).all(axis=1)


def is_shown(gaussians: Gaussians, least_opacity: float, box: np.ndarray) -> np.ndarray:
    """Return the mask [N] of the Gaussians with at least this opacity and their means in a box with corners [2, 3]."""
    return (np.asarray(gaussians.opacities) >= least_opacity) & is_in_box(gaussians.numpy()["means"], box)


def box_edges(box: np.ndarray) -> np.ndarray:
    """Return the end points [12, 2, 3] of the edges of a box with corners [2, 3]."""
    corners = np.array(list(product((0, 1), repeat=3)))
    pairs = [(a, b) for a, b in product(range(8), repeat=2) if a < b and np.abs(corners[a] - corners[b]).sum() == 1]
    return np.where(corners[pairs] == 0, box[0], box[1])

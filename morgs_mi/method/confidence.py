"""Motion masks of key views at keyframes: the flow mask (eq. 9), refined to whole objects (eq. 10).

The masks supervise the confidence (eq. 11). A string selects the refinement (see `mask_refiners`).
"""

from __future__ import annotations

import numpy as np

from morgs_mi.method.flow_sources.flow_registry import NOISE_PX
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS, MaskConfig

# px, the width of an image that `MaskConfig.floor` refers to.
_FLOOR_WIDTH = 1352


def motion_floor(width: int, config: MaskConfig) -> float:
    """Return the speed in pixels, in an image of `width` pixels, below which nothing counts as
    moving.
    """
    return max(config.floor * width / _FLOOR_WIDTH, NOISE_PX)


def flow_mask(motion: np.ndarray, reliable: np.ndarray, config: MaskConfig) -> np.ndarray:
    """Return the mask of moving pixels [H, W] bool: the motion exceeds its `motion_floor` (eq. 9).

    Args:
        motion: [H, W, 2] in pixels, of either sign.
        reliable: [H, W] bool; unreliable pixels are not in the mask.
        config: settings of the threshold.
    """
    return (np.linalg.norm(motion, axis=-1) > motion_floor(motion.shape[1], config)) & reliable


def motion_mask(
    image: np.ndarray,
    motion: np.ndarray,
    reliable: np.ndarray,
    method: str,
    config: MaskConfig,
) -> np.ndarray:
    """Return the motion mask [H, W] bool: the flow mask, refined (eq. 10).

    Args:
        image: frame t [H, W, 3], RGB, uint8 or float in [0, 1].
        motion: [H, W, 2] in pixels on frame t's grid.
        reliable: [H, W] bool, see `consistency_mask`.
        method: an entry of `MASK_REFINERS`.
        config: settings of the flow mask and its refinement.

    Raises:
        ValueError: the method is not registered, or as the refiner.
    """
    return MASK_REFINERS.make(method, config)(image, flow_mask(motion, reliable, config))

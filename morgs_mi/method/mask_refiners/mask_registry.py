"""Selection of a mask refiner by one string.

A refiner takes frame t [H, W, 3] and the flow mask [H, W] bool (eq. 9) and returns the motion mask
[H, W] bool (eq. 10). docs/experiments/flow.md compares the refiners.

A new refiner is one module in this package that decorates a factory with `MASK_REFINERS.register`;
docs/masks.md has an example. A refiner outside this package registers itself in the same way where
it is imported.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from morgs_mi.method.method_registry import Registry
from morgs_mi.platform.config import Count, NonNegative, config_class


@config_class
class MaskConfig:
    """Settings of the flow mask (eq. 9) and of its refinement (eq. 10).

    Raises:
        ValueError: a number is out of range.
    """

    floor: NonNegative = 0.5
    """Speed above which a pixel moves, in pixels in an image of 1352 px width, N3DV's half
    resolution; it is proportional to the width, as the motion of a scene is."""
    prompts: Count = 16
    """Largest connected components of the flow mask that become prompts of SAM2. Each costs a run
    of the decoder; the smaller ones stay as they are in the flow mask."""


MaskRefiner = Callable[[np.ndarray, np.ndarray], np.ndarray]

MASK_REFINERS: Registry[MaskRefiner, MaskConfig] = Registry(
    "MotionConfig()", "mask_method", MaskConfig
)
"""Refiners by name, e.g. ``grabcut`` (see `opencv_masks`)."""


MASK_REFINERS.register("none")(lambda argument, config: lambda image, mask: mask)

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

from morgs_mi.method.mask_refiners.mask_config import MaskConfig
from morgs_mi.method.method_registry import Registry

MaskRefiner = Callable[[np.ndarray, np.ndarray], np.ndarray]

MASK_REFINERS: Registry[MaskRefiner, MaskConfig] = Registry("mask_refiner()", "mask_method")


def mask_refiner(mask_method: str, config: MaskConfig | None = None) -> MaskRefiner:
    """Return the mask refiner that a string selects.

    Args:
        mask_method: one of `MASK_REFINERS.usages`, e.g. ``grabcut`` (see `opencv_masks`) or
            ``sam2:ENCODER.onnx,DECODER.onnx`` (see `network`).
        config: settings of the refiners; None: the defaults.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: the string selects no refiner, or as `SegmentNetwork`.
    """
    return MASK_REFINERS.make(mask_method, config or MaskConfig())


@MASK_REFINERS.register("none")
def _none(argument: str, config: MaskConfig) -> MaskRefiner:
    return lambda image, mask: mask

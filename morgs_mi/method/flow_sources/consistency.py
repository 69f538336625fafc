"""Forward-backward check of optical flow."""

from __future__ import annotations

import cv2
import numpy as np

from morgs_mi.method.flow_sources.flow_config import FlowConfig


def consistency_mask(
    flow: np.ndarray, back: np.ndarray, config: FlowConfig | None = None
) -> np.ndarray:
    """Return the mask of reliable flow [H, W], bool: pixels that the flow back returns to where
    they started.

    |F + B|^2 < 0.01 (|F|^2 + |B|^2) + 0.5 px^2, with B sampled at x + F(x) (Sundaram, Brox and
    Keutzer, ECCV 2010). Pixels that become hidden or leave the image fail.

    Args:
        flow: F [H, W, 2] in pixels, from one frame to another.
        back: B [H, W, 2], from the other frame to the first, on the other frame's grid.
        config: the two tolerances; None: the defaults above.
    """
    config = config or FlowConfig()
    height, width = flow.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x = x + flow[..., 0]
    y = y + flow[..., 1]
    back = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mismatch = _squared(flow + back)
    length = _squared(flow) + _squared(back)
    agrees = mismatch < config.consistency_relative * length + config.consistency_absolute
    return agrees & _is_within(x, width) & _is_within(y, height)


def _is_within(coordinates: np.ndarray, size: int) -> np.ndarray:
    """Return the mask of the coordinates that lie in an image of a width or height.

    It ends half a pixel beyond the outermost centres, so the flow's own error does not reject the
    border.
    """
    return (coordinates > -0.5) & (coordinates < size - 0.5)


def _squared(vectors: np.ndarray) -> np.ndarray:
    return np.einsum("hwc,hwc->hw", vectors, vectors)

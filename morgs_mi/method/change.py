"""Detection of the pixels of a fixed camera that changed by more than noise.

Changes of brightness are averaged over a window, which averages out noise and keeps what is visible. The remaining
noise is estimated from the median absolute deviation over the image, which holds while most of the image is static;
otherwise a grey level bounds it, which is more than what remains of a noise of six grey levels per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

__all__ = ["ChangeConfig", "box_around", "change_map", "change_mask", "change_noise", "update_reference"]

_GREY_LEVEL = 1 / 255


@dataclass(frozen=True)
class ChangeConfig:
    """Settings of the change detection."""

    window: int = 5
    """Side of the window over which changes are averaged, in px."""
    sigmas: float = 5.0
    """Threshold in standard deviations of the noise: normal noise exceeds 5 at less than one of 1.4 million pixels."""
    min_change: float = _GREY_LEVEL
    """Least threshold and bound of the estimated noise, of 1: a grey level."""
    min_margin: int = 24
    """Least margin of the box around a change, in px: flow needs something to match."""


def change_map(before: np.ndarray, after: np.ndarray, config: ChangeConfig | None = None) -> np.ndarray:
    """Return the change of brightness, averaged over the window, [H, W], of 1.

    Args:
        before: an earlier image of the same camera [H, W, 3], uint8 or float in [0, 1].
        after: a later one, likewise.
        config: settings.
    """
    config = config or ChangeConfig()
    if before.dtype == np.uint8 and after.dtype == np.uint8:
        change = cv2.subtract(after, before, dtype=cv2.CV_16S).astype(np.float32)
        change = cv2.transform(change, np.full((1, 3), 1 / (3 * 255), np.float32))
    else:
        change = (after - before).mean(-1)
    # Zero padding: reflection would double the noise at the border.
    return cv2.blur(change, (config.window, config.window), borderType=cv2.BORDER_CONSTANT)


def change_noise(change: np.ndarray, config: ChangeConfig | None = None) -> float:
    """Return the standard deviation of the noise in a `change_map`, at most `min_change`."""
    sample = change.ravel()[:: max(1, change.size // 100_000)]
    return min(1.4826 * float(np.median(np.abs(sample - np.median(sample)))), (config or ChangeConfig()).min_change)


def change_mask(
    before: np.ndarray, after: np.ndarray, valid: np.ndarray | None = None, config: ChangeConfig | None = None
) -> np.ndarray:
    """Return the mask of changed pixels [H, W], bool.

    Args:
        before: an earlier image of the same camera [H, W, 3], uint8 or float in [0, 1].
        after: a later one, likewise.
        valid: [H, W] bool, pixels that count; None: all.
        config: settings.
    """
    config = config or ChangeConfig()
    change = change_map(before, after, config)
    mask = np.abs(change) > max(config.sigmas * change_noise(change, config), config.min_change)
    return mask if valid is None else mask & valid


def update_reference(reference: np.ndarray, image: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the image that the next frame is compared with: the reference, replaced where the image changed.

    So a slow change is detected once it has added up.

    Args:
        reference: [H, W, 3].
        image: of the same camera [H, W, 3].
        change: the `change_mask` of both [H, W].
    """
    return np.where(change[..., None], image, reference)


def box_around(mask: np.ndarray, config: ChangeConfig | None = None) -> tuple[slice, slice] | None:
    """Return rows and columns of the smallest box around a mask [H, W], enlarged by half its size on all sides.

    The static surroundings of a motion are needed to separate it from noise. None where the mask is empty.
    """
    if not mask.any():
        return None
    spans = []
    for axis in (0, 1):
        (places,) = np.nonzero(mask.any(axis=1 - axis))
        low, high = int(places[0]), int(places[-1]) + 1
        margin = max((config or ChangeConfig()).min_margin, (high - low) // 2)
        spans.append(slice(max(low - margin, 0), min(high + margin, mask.shape[axis])))
    return spans[0], spans[1]

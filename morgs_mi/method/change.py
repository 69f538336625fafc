"""Detection of the pixels of a fixed camera that changed by more than noise.

Brightness and two differences of colours are compared, the latter at half the resolution, as video stores them. Each is
averaged over a window, which averages out noise and keeps what is visible. A threshold follows from the noise: from
that of the whole image, the median absolute deviation of the averaged change, which holds while most of the image is
static and is bounded by a grey level; and from that of the surroundings, where it is larger, as in penumbrae of a path
tracer. There, it is the median absolute deviation of the change minus its average over 3 x 3 pixels, which motion and
shadows hardly contribute to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

__all__ = ["ChangeConfig", "box_around", "change_mask", "moving_region", "update_reference"]

_GREY_LEVEL = 1 / 255
# Brightness, red minus green, and yellow minus blue; the absolute weights of each sum to 1.
_BRIGHTNESS = np.full((1, 3), 1 / 3, np.float32)
_COLOR = np.array([[0.5, -0.5, 0], [0.25, 0.25, -0.5]], np.float32)


@dataclass(frozen=True)
class ChangeConfig:
    """Settings of the change detection."""

    window: int = 5
    """Side of the window over which changes of brightness are averaged, in px."""
    sigmas: float = 5.0
    """Threshold in standard deviations of the noise: normal noise exceeds 5 at less than one of 1.4 million pixels."""
    noise_window: int = 31
    """Side of the window in which the noise of the surroundings is estimated, in px: larger than thin moving parts,
    which are no noise."""
    min_change: float = _GREY_LEVEL
    """Least threshold and bound of the noise of the whole image, of 1: a grey level."""
    min_margin: int = 24
    """Least margin of the box around a change, in px: flow needs something to match."""
    closing: int = 5
    """Side of the window that closes gaps in the outline of a moving object, in px."""


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
    H, W = before.shape[:2]
    if before.dtype == np.uint8 and after.dtype == np.uint8:
        difference, unit = cv2.subtract(after, before, dtype=cv2.CV_16S).astype(np.float32), 255.0
    else:
        difference, unit = np.subtract(after, before, dtype=np.float32), 1.0
    mask = _exceeds_noise(cv2.transform(difference, _BRIGHTNESS) / unit, 1, config)
    half = cv2.resize(difference, (max(W // 2, 1), max(H // 2, 1)), interpolation=cv2.INTER_AREA)
    for channel in cv2.split(cv2.transform(half, _COLOR) / unit):
        exceeds = _exceeds_noise(channel, 2, config).astype(np.uint8)
        mask |= cv2.resize(exceeds, (W, H), interpolation=cv2.INTER_NEAREST) > 0
    return mask if valid is None else mask & valid


def _exceeds_noise(change: np.ndarray, scale: int, config: ChangeConfig) -> np.ndarray:
    """Return where a change [H, W], of 1, at 1 / scale of the resolution exceeds its noise on average, bool [H, W]."""
    window = max(config.window // scale, 1) | 1
    # Zero padding: reflection would double the noise at the border.
    average = cv2.blur(change, (window, window), borderType=cv2.BORDER_CONSTANT)
    sample = average.ravel()[:: max(1, average.size // 100_000)]
    everywhere = min(_deviation(float(np.median(np.abs(sample - np.median(sample))))), config.min_change)
    local = _noise_of_surroundings(change, scale, config) / window
    return np.abs(average) > np.maximum(config.sigmas * np.maximum(local, everywhere), config.min_change)


def _noise_of_surroundings(change: np.ndarray, scale: int, config: ChangeConfig) -> np.ndarray:
    """Return the standard deviation [H, W] of the noise of single pixels."""
    height, width = change.shape
    # White noise keeps 8/9 of its variance.
    noise = np.abs(change - cv2.blur(change, (3, 3)))[:: 2 // scale, :: 2 // scale] / np.sqrt(8 / 9)
    levels = np.minimum(noise * (16 / _GREY_LEVEL), 255).astype(np.uint8)  # OpenCV's large medians are of bytes
    median = cv2.medianBlur(levels, config.noise_window // 2 | 1).astype(np.float32)
    return _deviation(cv2.resize(median, (width, height)) * (_GREY_LEVEL / 16))


def _deviation(median: Any) -> Any:
    """Return the standard deviation of normal noise with this median absolute deviation."""
    return 1.4826 * median


def moving_region(change: np.ndarray, config: ChangeConfig | None = None) -> np.ndarray:
    """Return the pixels [H, W] that may have moved: the changed ones and what they enclose.

    The inside of a plain object does not change where it moves, but its outline does.

    Args:
        change: the `change_mask` [H, W].
        config: settings.
    """
    size = (config or ChangeConfig()).closing
    closed = np.pad(change.astype(np.uint8), 2 * size)
    closed = cv2.morphologyEx(closed, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    cv2.floodFill(closed, None, (0, 0), 2)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return (closed != 2)[2 * size : -2 * size, 2 * size : -2 * size]


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

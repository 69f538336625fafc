"""Detection of the pixels of a fixed camera that changed by more than noise.

Brightness and two differences of colours are compared, the latter at half the resolution, as video
stores them. Each is averaged over a window, which removes noise and preserves visible changes. The
threshold follows from the larger of two estimates of the noise, which is normal in both:

- of the whole image: the median absolute deviation of the averaged change, at most a grey level. It
  holds while most of the image is static.
- of the surroundings, e.g. in penumbrae of a path tracer: the median absolute deviation of mixed
  differences, (a - b) - (c - d) of 2 x 2 pixels, to which motion and shadows hardly contribute.

The noise of JPEG and of video codecs is not normal: whole blocks of 8 x 8 pixels, and of 16 x 16
pixels in colour, change by one step at a time, which no average over a window removes. A connected
change therefore counts only if it exceeds a second, larger threshold somewhere, as in the
hysteresis of Canny (1986). A faint change that does not is compared with the same reference again,
so it counts once it has grown.
"""

from __future__ import annotations

import cv2
import numpy as np

NORMAL = 1.4826
"""Standard deviations of normal noise in a median absolute deviation."""
# Of 1; also the least threshold, and the bound of the noise of the whole image.
_GREY_LEVEL = 1 / 255
# Threshold in standard deviations of the noise: normal noise exceeds 5 at less than one of 1.4
# million pixels.
_SIGMAS = 5.0
# Change that a connected change must exceed in one of its pixels, of 1: blocks of compressed video
# change by less.
MIN_PEAK = 4 * _GREY_LEVEL
# px: 5 x 5 groups of pixels, that far apart, are a sample of the noise that thin moving parts do
# not dominate.
_NOISE_STEP = 4
# Side of the window over which changes of brightness are averaged, in px.
_WINDOW = 5
# Side of the window that closes gaps in the outline of a moving object, in px.
_CLOSING = 5
# Least margin of the box around a change, in px: flow needs something to match.
_MARGIN = 24
_SUM = np.ones((1, 3), np.float32)
# Red minus green, and yellow minus blue; the absolute weights of each sum to 1 grey level.
_COLORS = _GREY_LEVEL * np.array([[0.5, -0.5, 0], [0.25, 0.25, -0.5]])


def change_mask(
    reference: np.ndarray,
    image: np.ndarray,
    valid: np.ndarray | None,
) -> np.ndarray:
    """Return the mask of changed pixels [H, W], bool.

    Args:
        reference: an earlier image of the same camera, uint8 [H, W, 3].
        image: a later one, likewise.
        valid: [H, W] bool, pixels that count; None: all.
    """
    H, W = reference.shape[:2]
    difference = cv2.subtract(image, reference, dtype=cv2.CV_16S)
    brightness = cv2.transform(difference, _SUM) * np.float32(_GREY_LEVEL / 3)
    levels = _levels(brightness, 1)
    half_size = (max(W // 2, 1), max(H // 2, 1))
    half = cv2.resize(difference, half_size, interpolation=cv2.INTER_AREA).astype(np.float32)
    for channel in cv2.split(cv2.transform(half, _COLORS)):
        color_levels = _levels(channel, 2)
        pixel_levels = cv2.resize(color_levels, (W, H), interpolation=cv2.INTER_NEAREST)
        levels = np.maximum(levels, pixel_levels)
    levels = levels if valid is None else levels * valid
    # The connected changes that have a peak.
    count, labels = cv2.connectedComponents((levels > 0).astype(np.uint8))
    has_peak = np.zeros(count, bool)
    labels = np.asarray(labels, np.int32)
    has_peak[labels[levels > 1]] = True
    return has_peak[labels]


def _levels(change: np.ndarray, scale: int) -> np.ndarray:
    """Return 1 where a change [H, W], of 1, exceeds its noise on average, 2 where also `MIN_PEAK`,
    else 0, uint8.

    Args:
        change: at 1 / scale of the resolution.
        scale: of the resolution.
    """
    window = _WINDOW // scale | 1
    # Zero padding: reflection would double the noise at the border.
    average = cv2.blur(change, (window, window), borderType=cv2.BORDER_CONSTANT)
    sample = average.ravel()[:: max(1, average.size // 20_000)]
    everywhere = min(NORMAL * float(np.median(np.abs(sample - np.median(sample)))), _GREY_LEVEL)
    noise = np.maximum(_noise_of_surroundings(change, _NOISE_STEP // scale) / window, everywhere)
    threshold = np.maximum(_SIGMAS * noise, _GREY_LEVEL).astype(np.float32)
    size = np.abs(average)
    exceeds = size > cv2.resize(threshold, change.shape[::-1])
    return exceeds.astype(np.uint8) + (exceeds & (size > MIN_PEAK))


def _noise_of_surroundings(change: np.ndarray, step: int) -> np.ndarray:
    """Return the standard deviation of the noise of single pixels at one group of 2 x 2 pixels in
    `step` x `step`.
    """
    height, width = change.shape
    change = change[: height // step * step, : width // step * step]
    if not change.size:
        return np.zeros((1, 1), np.float32)
    a, b, c, d = (change[y::step, x::step] for y in (0, 1) for x in (0, 1))
    return NORMAL * cv2.blur(cv2.medianBlur(np.abs(a - b - c + d) / 2, 5), (3, 3))


def moving_region(change: np.ndarray) -> np.ndarray:
    """Return the pixels [H, W] that may have moved: the changed pixels and those that they enclose.

    The inside of a plain object does not change where it moves, but its outline does.

    Args:
        change: the `change_mask` [H, W].
    """
    margin = 2 * _CLOSING
    box = box_around(change) or np.s_[:, :]
    closing = np.pad(change[box].astype(np.uint8), margin)
    closing = cv2.morphologyEx(closing, cv2.MORPH_CLOSE, np.ones((_CLOSING, _CLOSING), np.uint8))
    cv2.floodFill(closing, None, (0, 0), 2)  # pyright: ignore[reportCallIssue, reportArgumentType]
    region = np.zeros_like(change)
    region[box] = (closing != 2)[margin:-margin, margin:-margin]
    return region


def box_around(mask: np.ndarray) -> tuple[slice, slice] | None:
    """Return rows and columns of the smallest box around a mask [H, W], enlarged by half its size
    on all sides.

    The static surroundings of a motion are needed to separate it from noise. None where the mask is
    empty.
    """
    if not mask.any():
        return None
    spans = []
    for line in (np.any(mask, axis=1), np.any(mask, axis=0)):
        (places,) = np.nonzero(line)
        low = int(places[0])
        high = int(places[-1]) + 1
        margin = max(_MARGIN, (high - low) // 2)
        spans.append(slice(max(low - margin, 0), min(high + margin, len(line))))
    return spans[0], spans[1]

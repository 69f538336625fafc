"""What changes from one picture of a fixed camera to another by more than noise, and who may be the cause.

Changes of brightness are averaged over 5x5 pixels, in which noise averages out and what is seen does not. How much
noise is left is told from the median absolute deviation over the picture, which holds while most of it stands still;
where it does not, a grey level is the bound, more than what is left of six in every pixel.
"""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["around", "change_map", "changed", "noise_of", "renewed"]

_WINDOW = 5
# Of 1.4 million pixels, normal noise takes less than one beyond five standard deviations.
_SIGMAS = 5
_GREY_LEVEL = 1 / 255
# px, around a box: what moves comes from there, and flow needs something to match.
_LEAST_MARGIN = 24


def change_map(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the change of brightness, averaged over 5x5 pixels, [H, W], from two pictures [H, W, 3].

    They are uint8, or floats in [0, 1].
    """
    if before.dtype == np.uint8 and after.dtype == np.uint8:
        change = cv2.subtract(after, before, dtype=cv2.CV_16S).astype(np.float32)
        change = cv2.transform(change, np.full((1, 3), 1 / (3 * 255), np.float32))
    else:
        change = (after - before).mean(-1)
    # Zeros around: at the border a mirror would double what noise there is.
    return cv2.blur(change, (_WINDOW, _WINDOW), borderType=cv2.BORDER_CONSTANT)


def noise_of(change: np.ndarray) -> float:
    """Return the standard deviation of the noise in a map of changes, at most a grey level."""
    sample = change.ravel()[:: max(1, change.size // 100_000)]
    return min(1.4826 * float(np.median(np.abs(sample - np.median(sample)))), _GREY_LEVEL)


def changed(before: np.ndarray, after: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Return where a picture has changed by more than its noise and one grey level, bool [H, W].

    Args:
        before: an earlier picture of the same camera [H, W, 3], uint8.
        after: this one.
        valid: [H, W] bool, what counts; None: everything.
    """
    change = change_map(before, after)
    found = np.abs(change) > max(_SIGMAS * noise_of(change), _GREY_LEVEL)
    return found if valid is None else found & valid


def renewed(
    reference: np.ndarray | None, image: np.ndarray | None, valid: np.ndarray | None = None
) -> np.ndarray | None:
    """Return what the next picture is to be compared with: the reference, renewed where the picture has changed.

    What changes slowly is thus found once it has changed enough. None stands for no picture.
    """
    if reference is None or image is None:
        return reference if image is None else image
    return np.where(changed(reference, image, valid)[..., None], image, reference)


def around(change: np.ndarray) -> tuple[slice, slice] | None:
    """Return the rows and columns of the smallest box around what has changed, with half its size on all sides.

    What surrounds a motion tells it from the noise. None where nothing has changed.
    """
    if not change.any():
        return None
    spans = []
    for axis in (0, 1):
        (places,) = np.nonzero(change.any(axis=1 - axis))
        low, high = int(places[0]), int(places[-1]) + 1
        margin = max(_LEAST_MARGIN, (high - low) // 2)
        spans.append(slice(max(low - margin, 0), min(high + margin, change.shape[axis])))
    return spans[0], spans[1]

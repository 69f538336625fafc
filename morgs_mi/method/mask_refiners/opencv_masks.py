"""Motion masks refined by colours: GrabCut of OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from morgs_mi.core.color_space import byte_values
from morgs_mi.method.exposure import thumbnail
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS

# Width in pixels to which GrabCut reduces an image. Its cost grows with the number of pixels, and a
# mask needs the object's outline, not its details.
_WIDTH = 320
# Radius in pixels of the opening that removes specks.
_OPENING = 1
# Radius of the closing that fills holes, in widths of the mask; at least a pixel.
_CLOSING = 0.005
# Iterations of GrabCut.
_ITERATIONS = 2
# Distance from the flow mask within which GrabCut may add pixels, in longer sides of the image.
_REACH = 0.05
# Share of the image above which GrabCut is skipped: the rest has too few colours to learn from.
_COVERAGE = 0.9


def refine_mask(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the mask of the objects [H, W] bool that a motion mask lies on, by GrabCut on colours.

    GrabCut (Rother, Kolmogorov and Blake, SIGGRAPH 2004) starts from the mask with specks removed
    and may add pixels near it. If nothing is left of the mask, or it covers nearly everything, one
    side has no colours to learn from: the mask is returned with its specks removed and holes
    closed.

    Args:
        image: [H, W, 3], RGB, uint8 or float in [0, 1].
        mask: [H, W] bool.
    """
    clean = clean_mask(mask)
    small = thumbnail(byte_values(image), _WIDTH)
    seed = cv2.resize(clean.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    near = cv2.dilate(seed, _disc(int(max(seed.shape) * _REACH)))
    if not seed.any() or near.all() or seed.mean() > _COVERAGE:
        return clean
    labels = np.where(near > 0, np.where(seed > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD)
    cv2.setRNGSeed(0)  # GrabCut's k-means starts at random
    models = np.zeros((2, 1, 65))  # of the background and of the foreground
    labels, _, _ = cv2.grabCut(
        small,
        labels.astype(np.uint8),
        (0, 0, 0, 0),
        models[0],
        models[1],
        _ITERATIONS,
        cv2.GC_INIT_WITH_MASK,
    )
    return clean_mask(_enlarged(np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)), mask.shape))


def clean_mask(mask: np.ndarray) -> np.ndarray:
    """Return a mask [H, W] bool with its specks removed and its holes closed.

    Args:
        mask: [H, W] bool.
    """
    opening = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(_OPENING))
    return (
        cv2.morphologyEx(opening, cv2.MORPH_CLOSE, _disc(max(1, int(mask.shape[1] * _CLOSING)))) > 0
    )


MASK_REFINERS.register("grabcut")(
    lambda argument, config: lambda image, mask: mask | refine_mask(image, mask)
)


def _enlarged(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return cv2.resize(mask.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))

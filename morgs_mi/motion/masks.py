"""Motion masks on key views at keyframes: what moves (eq. 9), grown to whole objects and united (eq. 10)."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["flow_mask", "flow_threshold", "least_motion", "motion_mask", "refine_mask"]

# The floor under the threshold is 0.5 px at N3DV's half resolution and shrinks with the width, as the motion
# of a scene does; below 0.2 px it would be in the noise of the flow itself, whatever the width.
REFERENCE_WIDTH = 1352
FLOOR = 0.5
NOISE_FLOOR = 0.2

# GrabCut's cost falls with the number of pixels and its mask is only a guide: objects, not hairs.
GRABCUT_WIDTH = 320


def least_motion(width: int) -> float:
    """Return the motion in pixels, in a picture so many pixels wide, below which nothing is said to move."""
    return max(FLOOR * width / REFERENCE_WIDTH, NOISE_FLOOR)


def flow_threshold(motion: np.ndarray, reliable: np.ndarray | None = None) -> float:
    """Return the speed in pixels above which something moves: max(floor, median + 4 MAD) of the speeds.

    The median takes it that less than half of the picture moves. Only reliable pixels count.
    """
    speed = np.linalg.norm(motion, axis=-1)
    speed = speed[reliable] if reliable is not None and reliable.any() else speed.ravel()
    median = np.median(speed)
    spread = np.median(np.abs(speed - median))
    return float(max(least_motion(motion.shape[1]), median + 4 * spread))


def flow_mask(motion: np.ndarray, reliable: np.ndarray | None = None) -> np.ndarray:
    """Return where the motion exceeds its own threshold, [H, W] bool (eq. 9, see `flow_threshold`).

    Args:
        motion: [H, W, 2] in pixels, of either sign.
        reliable: [H, W] bool; what is not reliable is not in the mask.

    Raises:
        ValueError: `motion` is not [H, W, 2] or `reliable` has another size.
    """
    if motion.ndim != 3 or motion.shape[2] != 2:
        raise ValueError(f"flow_mask(): `motion` must be [H, W, 2], got {motion.shape}.")
    if reliable is not None and reliable.shape != motion.shape[:2]:
        raise ValueError(f"flow_mask(): `reliable` must be {motion.shape[:2]}, got {reliable.shape}.")
    moves = np.linalg.norm(motion, axis=-1) > flow_threshold(motion, reliable)
    return moves if reliable is None else moves & reliable


def refine_mask(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the objects [H, W] bool that a motion mask points at, by GrabCut on colours.

    GrabCut (Rother, Kolmogorov and Blake, SIGGRAPH 2004) starts from the mask with specks removed and may
    add what lies near it. A mask that has nothing left, or covers nearly everything, leaves one side without
    colours to learn from: it is returned with its specks removed and holes closed.

    Args:
        image: [H, W, 3], RGB, uint8 or float in [0, 1].
        mask: [H, W] bool.

    Raises:
        ValueError: the sizes of image and mask differ.
    """
    if image.shape != (*mask.shape, 3):
        raise ValueError(f"refine_mask(): `image` must be [H, W, 3] with H, W = {mask.shape}, got {image.shape}.")
    clean = _cleaned(mask)
    height, width = mask.shape
    scale = min(1.0, GRABCUT_WIDTH / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    seed = cv2.resize(clean.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    near = cv2.dilate(seed, _disc(max(size) // 20))
    if not seed.any() or near.all() or seed.mean() > 0.9:
        return clean
    if image.dtype != np.uint8:
        image = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    labels = np.where(near > 0, np.where(seed > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD).astype(np.uint8)
    cv2.setRNGSeed(0)  # its k-means starts at random
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    labels, _, _ = cv2.grabCut(small, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    objects = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    objects = cv2.resize(objects, (width, height), interpolation=cv2.INTER_NEAREST)
    return _cleaned(objects > 0)


def motion_mask(image: np.ndarray, motion: np.ndarray, reliable: np.ndarray | None = None) -> np.ndarray:
    """Return what moves, [H, W] bool: the flow mask united with its objects (eq. 10).

    Args:
        image: frame t [H, W, 3], RGB, uint8 or float in [0, 1].
        motion: [H, W, 2] in pixels on frame t's grid.
        reliable: [H, W] bool, see `consistent`.

    Raises:
        ValueError: as `flow_mask` and `refine_mask`.
    """
    moves = flow_mask(motion, reliable)
    return moves | refine_mask(image, moves)


def _cleaned(mask: np.ndarray) -> np.ndarray:
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(1))
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _disc(max(1, mask.shape[1] // 200))) > 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))

"""Motion masks on key views at keyframes: what moves (eq. 9), refined to whole objects (eq. 10).

How it is refined is named by one string, as optical flow is; docs/masks.md compares the ways.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from morgs_mi.method.segment_network import SegmentNetwork

__all__ = [
    "MASK_METHODS",
    "MaskRefiner",
    "flow_mask",
    "flow_threshold",
    "mask_refiner",
    "motion_floor",
    "motion_mask",
    "refine_mask",
    "vote_superpixels",
]

MaskRefiner = Callable[[np.ndarray, np.ndarray], np.ndarray]

# The floor under the threshold is 0.5 px at N3DV's half resolution and shrinks with the width, as the motion
# of a scene does; below 0.2 px it would be in the noise of the flow itself, whatever the width.
REFERENCE_WIDTH = 1352
FLOOR = 0.5
NOISE_FLOOR = 0.2

# The cost of GrabCut and superpixels grows with the number of pixels and a mask is only a guide: objects, not hairs.
REFINED_WIDTH = 320
SUPERPIXEL_SIDE = 8  # pixels of that width
# Flow bleeds outwards, onto what stands still beside an object: a bare majority would keep all of that.
SUPERPIXEL_SHARE = 0.75


def motion_floor(width: int) -> float:
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
    return float(max(motion_floor(motion.shape[1]), median + 4 * spread))


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
    small = _shrunk(image)
    seed = cv2.resize(clean.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    near = cv2.dilate(seed, _disc(max(seed.shape) // 20))
    if not seed.any() or near.all() or seed.mean() > 0.9:
        return clean
    labels = np.where(near > 0, np.where(seed > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD).astype(np.uint8)
    cv2.setRNGSeed(0)  # its k-means starts at random
    labels, _, _ = cv2.grabCut(small, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    return _cleaned(_enlarged(np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)), mask.shape))


def vote_superpixels(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the superpixels [H, W] bool three quarters of which are in a motion mask.

    SLIC (Achanta et al., PAMI 2012) on colours in Lab. What the flow smeared over an edge is given up, and so is
    what is thinner than a superpixel, 8 pixels in a picture 320 wide. A picture with a side under two superpixels has
    none (OpenCV dies of a segmentation fault below one): its mask is returned as it is.

    Args:
        image: [H, W, 3], RGB, uint8 or float in [0, 1].
        mask: [H, W] bool.

    Raises:
        ValueError: the sizes of image and mask differ.
    """
    if image.shape != (*mask.shape, 3):
        raise ValueError(f"vote_superpixels(): `image` must be [H, W, 3] with H, W = {mask.shape}, got {image.shape}.")
    small = _shrunk(image)
    if min(small.shape[:2]) < 2 * SUPERPIXEL_SIDE:
        return mask
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
    slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLIC, SUPERPIXEL_SIDE, 10.0)
    slic.iterate(5)
    slic.enforceLabelConnectivity()
    labels = slic.getLabels()
    votes = cv2.resize(mask.astype(np.float32), labels.shape[::-1], interpolation=cv2.INTER_AREA)
    shares = np.bincount(labels.ravel(), votes.ravel()) / np.maximum(np.bincount(labels.ravel()), 1)
    return _enlarged(shares[labels] >= SUPERPIXEL_SHARE, mask.shape)


# Each takes frame t [H, W, 3] and the flow mask [H, W] and returns the motion mask [H, W].
MASK_METHODS: dict[str, MaskRefiner] = {
    "none": lambda image, moves: moves,
    "grabcut": lambda image, moves: moves | refine_mask(image, moves),
    "superpixels": vote_superpixels,
    "superpixels+grabcut": lambda image, moves: vote_superpixels(image, moves) | refine_mask(image, moves),
}


@lru_cache(maxsize=8)  # a network is loaded once
def mask_refiner(mask_method: str) -> MaskRefiner:
    """Return the refinement that a string names.

    Args:
        mask_method: a key of `MASK_METHODS`, or ``sam2:ENCODER.onnx,DECODER.onnx`` (see `segment_network`), whose
            objects are united with the flow mask (eq. 10).

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: the string names no refinement, or as `SegmentNetwork`.
    """
    if mask_method in MASK_METHODS:
        return MASK_METHODS[mask_method]
    kind, _, paths = mask_method.partition(":")
    encoder, _, decoder = paths.partition(",")
    if kind == "sam2" and encoder and decoder:
        network = SegmentNetwork(encoder, decoder)
        return lambda image, moves: moves | network(image, _cleaned(moves))
    known = ", ".join([*MASK_METHODS, "sam2:ENCODER.onnx,DECODER.onnx"])
    raise ValueError(f"mask_refiner(): `mask_method` must be one of {known}, got {mask_method!r}.")


def motion_mask(
    image: np.ndarray, motion: np.ndarray, reliable: np.ndarray | None = None, method: str = "grabcut"
) -> np.ndarray:
    """Return what moves, [H, W] bool: the flow mask, refined (eq. 10).

    Args:
        image: frame t [H, W, 3], RGB, uint8 or float in [0, 1].
        motion: [H, W, 2] in pixels on frame t's grid.
        reliable: [H, W] bool, see `consistency_mask`.
        method: as `mask_refiner` takes it.

    Raises:
        ValueError: as `flow_mask`, `mask_refiner` and what it names.
    """
    return mask_refiner(method)(image, flow_mask(motion, reliable))


def _shrunk(image: np.ndarray) -> np.ndarray:
    """Return a picture of bytes no wider than `REFINED_WIDTH`."""
    if image.dtype != np.uint8:
        image = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    height, width = image.shape[:2]
    scale = min(1.0, REFINED_WIDTH / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _enlarged(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return cv2.resize(mask.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _cleaned(mask: np.ndarray) -> np.ndarray:
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(1))
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _disc(max(1, mask.shape[1] // 200))) > 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))

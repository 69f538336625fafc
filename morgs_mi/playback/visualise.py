"""Pictures for reports: motion, confidence and depth in colour, labels, sheets, PNG files.

Every picture is uint8 RGB [H, W, 3].
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import cv2
import numpy as np

from morgs_mi.core.files import atomic_path

__all__ = [
    "confidence_image",
    "confidence_legend",
    "contact_sheet",
    "depth_image",
    "label",
    "motion_image",
    "motion_legend",
    "side_by_side",
    "time_slice",
    "to_uint8",
    "write_png",
]

GAP = 4
BACKGROUND = 255
NOTHING = (128, 128, 128)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Return a copy in uint8 RGB of a display-referred image: [H, W, 3], [H, W, 1] or [H, W]; floats span [0, 1].

    What is not finite becomes black.

    Raises:
        ValueError: another shape.
    """
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 3):
        raise ValueError(f"as_picture(): `image` must be [H, W], [H, W, 1] or [H, W, 3], got {image.shape}.")
    if image.dtype != np.uint8:
        image = (np.clip(np.nan_to_num(image, posinf=0, neginf=0), 0, 1) * 255 + 0.5).astype(np.uint8)
    return np.broadcast_to(image, (*image.shape[:2], 3)).copy()


def motion_image(motion: np.ndarray, scale_px: float) -> np.ndarray:
    """Return motion as colour: hue is the direction, saturation the speed, white is no motion.

    Right is red and hue turns clockwise on the screen: down yellow-green, left cyan, up violet. A speed of
    `scale_px` or more is fully saturated; one scale makes pictures comparable. Not finite is grey.

    Args:
        motion: [H, W, 2] in pixels, x to the right and y down.
        scale_px: the speed of full saturation, in pixels.

    Raises:
        ValueError: `motion` is not [H, W, 2] or the scale is not positive.
    """
    motion = np.asarray(motion, np.float32)
    if motion.ndim != 3 or motion.shape[2] != 2:
        raise ValueError(f"motion_picture(): `motion` must be [H, W, 2], got {motion.shape}.")
    if not scale_px > 0:
        raise ValueError(f"motion_picture(): `scale_px` must be positive, got {scale_px}.")
    known = np.isfinite(motion).all(-1)
    x, y = np.moveaxis(np.where(known[..., None], motion, 0), -1, 0)
    hue = np.rad2deg(np.arctan2(y, x)) % 360
    saturation = np.minimum(np.hypot(x, y) / scale_px, 1)
    hsv = np.stack([hue, saturation, np.ones_like(hue)], -1).astype(np.float32)
    picture = to_uint8(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))
    picture[~known] = NOTHING
    return picture


def motion_legend(scale_px: float, size: int = 96) -> np.ndarray:
    """Return the key [size, size, 3] to `motion_image`: a disc whose rim is `scale_px`, labelled with it."""
    axis = np.linspace(-scale_px, scale_px, size, dtype=np.float32)
    motion = np.stack(np.meshgrid(axis, axis), -1)
    motion[np.hypot(*np.moveaxis(motion, -1, 0)) > scale_px] = 0
    return label(motion_image(motion, scale_px), f"{scale_px:.3g} px")


def confidence_image(confidence: np.ndarray) -> np.ndarray:
    """Return [H, W] or [H, W, 1] in [0, 1] as colour: dark violet is still, bright yellow moves."""
    return _coloured(np.asarray(confidence, np.float64), cv2.COLORMAP_INFERNO)


def confidence_legend(size: int = 96) -> np.ndarray:
    """Return the key [size, size, 3] to `confidence_image`: a bar from 1 at the top to 0 at the bottom."""
    ramp = np.repeat(np.linspace(1, 0, size)[:, None], size // 3, axis=1)
    picture = np.full((size, size, 3), BACKGROUND, np.uint8)
    picture[:, : ramp.shape[1]] = confidence_image(ramp)
    for text, row in (("1 moves", 0.0), ("0.5", 0.5), ("0 still", 1.0)):
        place = (ramp.shape[1] + 4, round(12 + row * (size - 16)))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.35, (0, 0, 0), 1, cv2.LINE_AA)
    return picture


def time_slice(columns: Sequence[np.ndarray], least_width: int = 320) -> np.ndarray:
    """Return the same column of every frame [H, 3] side by side, time to the right: a picture [H, W, 3].

    What stands still is a horizontal streak, noise a rough one. The columns of a short clip are repeated until they
    fill `least_width` pixels.

    Raises:
        ValueError: no column.
    """
    if not columns:
        raise ValueError("time_slice(): there must be at least one column, got none.")
    return np.repeat(to_uint8(np.stack(columns, axis=1)), -(-least_width // len(columns)), axis=1)


def depth_image(depth: np.ndarray, near: float | None = None, far: float | None = None) -> np.ndarray:
    """Return depth [H, W] or [H, W, 1] as colour, red near and blue far, even in 1 / depth.

    Args:
        depth: world units; what is not positive and finite is grey.
        near: drawn red; default the 1st percentile.
        far: drawn blue; default the 99th percentile.
    """
    depth = np.asarray(depth, np.float64).reshape(np.shape(depth)[:2])
    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        return np.full((*depth.shape, 3), NOTHING, np.uint8)
    low, high = np.percentile(depth[known], (1, 99))
    near, far = near or low, far or high
    inverse = 1 / np.where(known, depth, far)
    span = max(1 / near - 1 / far, 1e-12)
    picture = _coloured((inverse - 1 / far) / span, cv2.COLORMAP_TURBO)
    picture[~known] = NOTHING
    return picture


def label(image: np.ndarray, text: str) -> np.ndarray:
    """Return the picture with `text` (ASCII) in its top left corner, white on a dark strip."""
    picture = to_uint8(image)
    scale = np.clip(picture.shape[1] / 640, 0.35, 1.0)
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, 2 if scale > 0.8 else 1
    (width, height), base = cv2.getTextSize(text, font, scale, thickness)
    strip = picture[: height + base + 4, : width + 8]
    strip[:] = strip // 4
    cv2.putText(picture, text, (4, height + 3), font, scale, (255, 255, 255), thickness, cv2.LINE_AA)
    return picture


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return the pictures in one row on white, tops aligned, 4 pixels apart.

    Raises:
        ValueError: no picture.
    """
    return _joined([to_uint8(image) for image in images], axis=1)


def contact_sheet(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Return rows of pictures (see `side_by_side`) one under the other, left edges aligned.

    Raises:
        ValueError: no row, or a row without a picture.
    """
    return _joined([side_by_side(row) for row in rows], axis=0)


def write_png(path: str | os.PathLike[str], image: np.ndarray) -> None:
    """Write a picture (see `to_uint8`) as PNG; the file appears whole or not at all.

    Missing folders are made.

    Raises:
        OSError: the file cannot be written; the message names it and the cause.
        ValueError: the image has no pixels or another shape.
    """
    picture = to_uint8(image)
    if not picture.size:
        raise ValueError(f"write_png(): the image for {path} has no pixels: {picture.shape}.")
    _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    with atomic_path(path, "write_png()") as partial:
        partial.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data.tobytes())


def _coloured(values: np.ndarray, colours: int) -> np.ndarray:
    grey = to_uint8(values.reshape(values.shape[:2]))[..., 0]
    return cv2.cvtColor(cv2.applyColorMap(grey, colours), cv2.COLOR_BGR2RGB)


def _joined(pictures: list[np.ndarray], axis: int) -> np.ndarray:
    if not pictures:
        raise ValueError("side_by_side(), contact_sheet(): there must be at least one picture, got none.")
    across = 1 - axis
    widest = max(picture.shape[across] for picture in pictures)
    parts = []
    for picture in pictures:
        border = [(0, 0)] * 3
        border[across] = (0, widest - picture.shape[across])
        border[axis] = (GAP if parts else 0, 0)
        parts.append(np.pad(picture, border, constant_values=BACKGROUND))
    return np.concatenate(parts, axis)

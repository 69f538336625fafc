"""Visualisation: images of motion, confidence, depth and errors, legends, labels, contact sheets,
PNG files.

All images that are returned are uint8 RGB [H, W, 3].
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from morgs_mi.core.color_space import byte_values
from morgs_mi.platform.checks import require
from morgs_mi.platform.files import FilePath, atomic_path
from morgs_mi.platform.png import png_bytes

GAP = 4
"""Space between the images of a row or sheet, in pixels."""
BACKGROUND = 255
"""Grey level of that space."""
UNDEFINED = (128, 128, 128)
"""Colour of pixels with a value that is not finite, or a depth that is not positive."""
LARGEST_ERROR = 0.1
"""Error of the brightest colour of `error_image`, as a share of white."""
# Weights of R, G, B in a grey image.
_LUMA = np.array([0.299, 0.587, 0.114])
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Return a display-referred image [H, W, 3], [H, W, 1] or [H, W] as a uint8 RGB copy; floats
    are in [0, 1].

    Values that are not finite become black.

    Raises:
        ValueError: the image has another shape.
    """
    image = np.asarray(image)
    require(
        image.ndim > 1 and image.shape[2:] in ((), (1,), (3,)),
        "to_uint8()",
        "`image` must be [H, W], [H, W, 1] or [H, W, 3]",
        image.shape,
        "pass one image",
    )
    levels = byte_values(np.nan_to_num(np.atleast_3d(image), posinf=0, neginf=0))
    return np.broadcast_to(levels, (*image.shape[:2], 3)).copy()


def motion_image(
    motion: np.ndarray, scale_px: float, color: np.ndarray | None = None
) -> np.ndarray:
    """Return motion as colours: the hue is the direction, the saturation is the speed. No motion is
    white, or the grey image of `color`.

    Right is red, and the hue increases clockwise on the screen: down is yellow-green, left is cyan,
    up is violet. Speeds of `scale_px` or more are fully saturated; images with the same scale are
    comparable. Values that are not finite are grey.

    Args:
        motion: [H, W, 2] in pixels, x to the right and y down.
        scale_px: speed of full saturation, in pixels.
        color: image [H, W, 3] that moves, see `to_uint8`; None: it is not shown.

    Raises:
        ValueError: `motion` is not [H, W, 2], or the scale is not positive.
    """
    motion = np.asarray(motion, np.float32)
    require(
        motion.shape[2:] == (2,) and scale_px > 0,
        "motion_image()",
        "`motion` must be [H, W, 2] and `scale_px` positive",
        f"{motion.shape} and {scale_px}",
        "pass the motion of one image",
    )
    valid = np.asarray(np.isfinite(motion).all(-1))
    x, y = np.moveaxis(np.where(valid[..., None], motion, 0), -1, 0)
    hue = np.rad2deg(np.arctan2(y, x)) % 360
    saturation = np.minimum(np.hypot(x, y) / scale_px, 1)
    hsv = np.stack([hue, saturation, np.ones_like(hue)], -1).astype(np.float32)
    image = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
    if color is not None:
        darkness = 1 - to_uint8(color) / 255 @ _LUMA
        image = image - ((1 - saturation) * darkness)[..., None]
    image = to_uint8(image)
    image[~valid] = UNDEFINED
    return image


def motion_legend(scale_px: float, size: int, color: np.ndarray | None = None) -> np.ndarray:
    """Return the legend [size, size, 3] of `motion_image`: a disc of its colours, with the speed
    `scale_px` at the rim, over the grey image of `color` [size, size, 3] or white.
    """
    axis = np.linspace(-scale_px, scale_px, size, dtype=np.float32)
    motion = np.stack(np.meshgrid(axis, axis), -1)
    motion[np.hypot(*np.moveaxis(motion, -1, 0)) > scale_px] = 0
    return motion_image(motion, scale_px, color)


def confidence_image(confidence: np.ndarray) -> np.ndarray:
    """Return [H, W] or [H, W, 1] in [0, 1] as colours: dark violet is static, bright yellow is
    moving.
    """
    return _apply_colour_map(confidence, cv2.COLORMAP_INFERNO)


def error_image(error: np.ndarray) -> np.ndarray:
    """Return absolute differences [H, W, C] of images in [0, 1] as colours, by the mean of the C
    components: black is none, bright yellow is `LARGEST_ERROR` and more.
    """
    return _apply_colour_map(error.mean(axis=-1) / LARGEST_ERROR, cv2.COLORMAP_MAGMA)


def depth_limits(depth: np.ndarray) -> np.ndarray:
    """Return the 1st and 99th percentile of the depths that are positive and finite; 1 and 1
    without any.
    """
    depths = depth[np.isfinite(depth) & (depth > 0)]
    return np.percentile(depths, (1, 99)) if depths.size else np.ones(2)


def depth_image(depth: np.ndarray) -> np.ndarray:
    """Return depth [H, W] or [H, W, 1] in world units as colours, linear in 1 / depth: bright
    yellow is the first of `depth_limits` and nearer, dark violet the second and farther.

    Values that are not positive and finite are grey.
    """
    depth = np.asarray(depth, np.float64).reshape(np.shape(depth)[:2])
    valid = np.isfinite(depth) & (depth > 0)
    near, far = depth_limits(depth)
    nearness = np.interp(1 / np.where(valid, depth, far), (1 / far, 1 / near), (0, 1))
    image = _apply_colour_map(nearness, cv2.COLORMAP_VIRIDIS)
    image[~valid] = UNDEFINED
    return image


def label(image: np.ndarray, text: str) -> np.ndarray:
    """Return the image with `text` (ASCII) in its top left corner, white on a dark strip."""
    image = to_uint8(image)
    letters = _letters(text, image)
    corner = image[: len(letters), : letters.shape[1]]
    corner //= 4
    np.maximum(corner, letters[: len(corner), : corner.shape[1]], out=corner)
    return image


def color_bar(image: np.ndarray, colors: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    """Return the image with a bar of `colors` [1, N, 3] along its lower edge, between the numbers
    at both ends.
    """
    image = to_uint8(image)
    H, W = image.shape[:2]
    first, last = (_letters(f"{number:.3g}", image) for number in ends)
    size = max(1, W - first.shape[1] - last.shape[1]), len(first)
    bar = np.concatenate([first, cv2.resize(colors, size), last], axis=1)[-H:, :W]
    image[-len(bar) :, : bar.shape[1]] = bar
    return image


def _letters(text: str, image: np.ndarray) -> np.ndarray:
    """Return a text [h, w, 3] white on black, as large as an image needs it."""
    scale = np.clip(image.shape[1] / 640, 0.35, 1.0)
    thickness = 2 if scale > 0.8 else 1
    (width, _), _ = cv2.getTextSize(text, _FONT, scale, thickness)
    (_, height), base = cv2.getTextSize("Ag", _FONT, scale, thickness)  # of any text
    letters = np.zeros((height + base + 4, width + 8, 3), np.uint8)
    white = (255, 255, 255)
    cv2.putText(letters, text, (4, height + 3), _FONT, scale, white, thickness, cv2.LINE_AA)
    return letters


def side_by_side(images: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """Return the images, at least one, in one row on white, aligned at the top, 4 pixels apart."""
    return _concatenate([to_uint8(image) for image in images], axis=1)


def contact_sheet(rows: Sequence[Sequence[np.ndarray] | np.ndarray]) -> np.ndarray:
    """Return rows of images (see `side_by_side`) below each other, aligned at the left."""
    return _concatenate([side_by_side(row) for row in rows], axis=0)


def write_png(path: FilePath, image: np.ndarray) -> None:
    """Write an image (see `to_uint8`) as PNG; the file is written atomically, missing folders are
    created.

    Raises:
        OSError: the file cannot be written; the message names it and the cause.
        ValueError: the image has a shape that `to_uint8` does not accept.
    """
    with atomic_path(path, "write_png()", parents=True) as partial:
        partial.write_bytes(png_bytes(to_uint8(image)))


def _apply_colour_map(values: np.ndarray, colour_map: int) -> np.ndarray:
    grey = to_uint8(np.reshape(values, np.shape(values)[:2]))[..., 0]
    return cv2.cvtColor(cv2.applyColorMap(grey, colour_map), cv2.COLOR_BGR2RGB)


def _concatenate(images: list[np.ndarray], axis: int) -> np.ndarray:
    largest = max(image.shape[1 - axis] for image in images)
    parts: list[np.ndarray] = []
    for image in images:
        border = [(0, 0)] * 3
        border[axis] = (GAP if parts else 0, 0)
        border[1 - axis] = (0, largest - image.shape[1 - axis])
        parts.append(np.pad(image, border, constant_values=BACKGROUND))
    return np.concatenate(parts, axis)

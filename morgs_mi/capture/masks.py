"""Masks of the pixels of a camera's clip that are used: opaque, and black in no image that masks
them out.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.io.clip_readers import FrameReader
from morgs_mi.io.exr import opaque_light
from morgs_mi.io.images import FolderReader, decode_image
from morgs_mi.io.listing import existing_file
from morgs_mi.platform.checks import few

# Headers of images without an alpha channel: JPEG, BMP, whose alpha channel is no mask, and PNG in
# grey (colour type 0) or RGB (2).
_OPAQUE = re.compile(rb"\xff\xd8|BM|\x89PNG.{21}[\0\2]", re.DOTALL)


def used_in_clip(
    reader: FrameReader, files: Sequence[Path], name: str
) -> tuple[np.ndarray | None, list[str]]:
    """Return the mask of the pixels of a clip that are opaque and in no mask black, None if all
    are, and notes.

    Args:
        reader: of the clip.
        files: masks of the size of the clip, or scaled versions of it.
        name: name of the camera.

    Raises:
        FileNotFoundError: a mask is missing.
        ValueError: a mask cannot be read or has another aspect ratio, or no pixel is left.
    """
    opaque, notes = opaque_pixels(reader, name)
    width = reader.width
    height = reader.height
    used_mask = np.ones((height, width), bool)
    for file in files:
        existing_file(file, "a mask", "copy it, or drop `mask_path`")
        image = np.atleast_3d(decode_image(file, cv2.IMREAD_UNCHANGED)) > 0
        # Neither black nor transparent.
        mask = np.any(image[..., :3], axis=2) & np.all(image[..., 3:], axis=2)
        rows, columns = mask.shape
        if abs(columns * height - rows * width) > min(columns, rows, width, height):
            raise ValueError(
                f"{file}: expected a mask of {width}x{height}, or scaled, got {columns}x{rows}; "
                "draw it at the size of its images."
            )
        used_mask &= scaled_mask(mask, width, height)
    if not used_mask.all():
        masks = few([file.name for file in files], 3)
        notes.append(f"{name}: {_unused(used_mask)} % of its pixels are masked out by {masks}.")
    if opaque is not None:
        used_mask &= opaque
    if not used_mask.any():
        place = few(files, 3) if files else reader.path
        raise ValueError(
            f"{place}: expected pixels of {name} that are used, got all black in a mask or "
            "transparent; correct the mask."
        )
    return None if used_mask.all() else used_mask, notes


def opaque_pixels(reader: FrameReader, name: str) -> tuple[np.ndarray | None, list[str]]:
    """Return the mask of the opaque pixels, None if all are opaque or the mask varies, and notes.

    The first, the middle and the last image are compared.
    """
    if not isinstance(reader, FolderReader):
        return None, []
    indices = sorted({0, reader.num_frames // 2, reader.num_frames - 1})
    shape = (reader.height, reader.width)
    mask, *others = (_opaque(reader.files[i], shape) for i in indices)
    if any(not np.array_equal(mask, other) for other in others):
        return None, [f"{name}: the alpha channel of its images changes over time and is ignored."]
    if mask.all():
        return None, []
    return mask, [f"{name}: {_unused(mask)} % of its pixels are transparent and masked out."]


def _unused(mask: np.ndarray) -> str:
    """Return the percentage of pixels that a mask leaves out."""
    return f"{100 * (1 - mask.mean()):.1f}"


def _opaque(file: Path, shape: tuple[int, int]) -> np.ndarray:
    """Return the mask of an image's opaque pixels [H, W]: all without an alpha channel, or if it is
    not readable.
    """
    mask = np.ones(shape, bool)
    with suppress(ValueError, OSError):
        with file.open("rb") as stream:
            header = stream.read(26)
        if header.startswith(b"\x76\x2f\x31\x01"):
            mask = opaque_light(file)
        elif not _OPAQUE.match(header):
            image = decode_image(file, cv2.IMREAD_UNCHANGED)
            if image.shape[2:] == (4,):
                mask = image[..., 3] == np.iinfo(image.dtype).max
    return mask if mask.shape == shape else np.ones(shape, bool)


def scaled_mask(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return a mask at another size [H, W], where a pixel is used if all that it shows are."""
    if mask.shape == (height, width):
        return mask
    size = (width, height)
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1 - 1e-4

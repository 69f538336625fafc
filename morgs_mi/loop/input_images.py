"""Images that a caller gives to the loop, as arrays: uint8 in sRGB, or float32 in linear light."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import kind_of
from morgs_mi.core.color_space import positive_light

InputImage: TypeAlias = Any
"""An image [H, W, 3]: a uint8 array in sRGB; linear light as a float array or a `mi.TensorXf`; or a
`mi.Bitmap`, whose flag `srgb_gamma` counts."""


def as_array(image: Any) -> Any:
    """Return a copy of a bitmap or a tensor as an array: uint8 if it is in sRGB of 8 bits, else
    linear float32.

    Any other value is returned as it is.
    """
    if isinstance(image, mi.Bitmap):
        is_display = image.srgb_gamma() and image.component_format() == mi.Struct.Type.UInt8
        number = mi.Struct.Type.UInt8 if is_display else mi.Struct.Type.Float32
        return np.array(image.convert(mi.Bitmap.PixelFormat.RGB, number, is_display))
    return np.array(dr.detach(image)) if dr.is_tensor_v(image) else image


def copied_images(
    cameras: Sequence[Camera], images: Sequence[InputImage | None], frame: int
) -> dict[int, np.ndarray]:
    """Return copies of the images of those views that have one, by view index, negative light set
    to 0.

    Raises:
        ValueError: their number is not that of the cameras, an image has another size or type than
            its camera, or light that is not finite, or the first frame has no image at all.
    """
    _check_count(images, len(cameras), frame)
    if not frame and all(image is None for image in images):
        raise ValueError(
            "step(): frame 0 must have an image of at least one view, got none; begin with one "
            "that has."
        )
    views = enumerate(zip(cameras, images, strict=True))
    return {
        view: _copy(image, camera, f"step(): frame {frame} of view {camera.name or view!r}")
        for view, (camera, image) in views
        if image is not None
    }


def _check_count(images: Any, count: int, frame: int) -> None:
    """Raise an error unless there are as many images as views."""
    is_sequence = isinstance(images, (Sequence, np.ndarray))
    image_count = len(images) if is_sequence else f"a {type(images).__name__}"
    if image_count != count:
        raise ValueError(
            f"step(): frame {frame} must have one image or None for each of {count} views, "
            f"got {image_count}."
        )


def _copy(image: InputImage, camera: Camera, place: str) -> np.ndarray:
    array = as_array(image)
    shape = (camera.height, camera.width, 3)
    is_image = isinstance(array, np.ndarray) and array.shape == shape
    if is_image and array.dtype == np.uint8:
        return array.copy()
    if is_image and array.dtype.kind == "f":
        return positive_light(array, place)
    raise ValueError(
        f"{place} must be uint8 {list(shape)}, or linear light in floats, got {kind_of(array)}; "
        "convert it."
    )

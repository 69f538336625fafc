"""Images that a caller gives to the loop, as arrays: uint8 in sRGB, or float32 in linear light.

Problems that the images of a frame show: views of one colour, and a cut to another scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.color_space import positive_light
from morgs_mi.core.view import View, Views
from morgs_mi.loop.seen_view import SeenView
from morgs_mi.method.exposure import thumbnail
from morgs_mi.platform.checks import kind_of, require
from morgs_mi.platform.threads import map_in_threads

InputImage: TypeAlias = Any
"""An image [H, W, 3]: a uint8 array in sRGB; linear light as a float array or a `mi.TensorXf`; or a
`mi.Bitmap`, whose flag `srgb_gamma` counts."""

FrameImages: TypeAlias = (
    "Sequence[InputImage | None] | Mapping[str, InputImage | None] | Views[View]"
)
"""One image or None for each view in the cameras' order, the images by the cameras' names, or
views with their images, such as ``frame.train`` of a capture's frames."""
# px: thumbnails of this width keep the layout of a scene, without noise and the motion between two
# frames.
_WIDTH = 16
# Standard deviation of the thumbnail of an image of one colour, in grey levels.
_PLAIN = 2.0
# Mean of a black image, in grey levels.
_BLACK = 16.0
# Correlation of the thumbnails of successive frames; it is 0.95 and more in recordings, and 0.7 and
# less at cuts.
_SAME_SCENE = 0.8
# Share of a thumbnail that changes by more than some grey levels: a few percent in recordings, half
# of it at cuts. A bright object alone, in fast motion before a dull scene, changes the correlation
# and less of the thumbnail.
_LEAST_CHANGED = 0.4
_CHANGE = 8.0


def as_array(image: Any) -> Any:
    """Return a copy of a bitmap or a tensor as an array: uint8 if it is in sRGB of 8 bits, else
    linear float32.

    Any other value is returned as it is.
    """
    if isinstance(image, mi.Bitmap):
        require(
            image.pixel_format() != mi.Bitmap.PixelFormat.MultiChannel,
            "images",
            "a bitmap must be grey or have colours",
            f"{image.channel_count()} channels",
            "pass one of the parts that `split()` returns",
        )
        is_display = image.srgb_gamma() and image.component_format() == mi.Struct.Type.UInt8
        number = mi.Struct.Type.UInt8 if is_display else mi.Struct.Type.Float32
        return np.array(image.convert(mi.Bitmap.PixelFormat.RGB, number, is_display))
    return np.array(dr.detach(image)) if dr.is_tensor_v(image) else image


def copied_images(
    views: Sequence[View], images: FrameImages, frame: int, kind: str = ""
) -> dict[int, np.ndarray]:
    """Return copies of the images of those views that have one, by view index, negative light set
    to 0.

    Args:
        views: the views.
        images: of the frame.
        frame: its index.
        kind: numbers of the images of earlier frames, uint8 or float32; empty: there are none.

    Raises:
        ValueError: as for `in_order`, an image has another size or type than its camera, light that
            is not finite or has 255 for white, or other numbers than the images before it, or the
            first frame has no image at all.
    """
    images = in_order(views, images, frame)
    if not frame and all(image is None for image in images):
        raise ValueError(
            "push(): frame 0 must have an image of at least one view, got none; begin with one "
            "that has."
        )
    copies = {}
    for v, (view, image) in enumerate(zip(views, images, strict=True)):
        if image is None:
            continue
        place = f"push(): frame {frame} of view {view.name or v!r}"
        array = as_array(image)
        shape = (view.camera.height, view.camera.width, 3)
        is_image = isinstance(array, np.ndarray) and array.shape == shape
        if is_image and array.dtype == np.uint8:
            copies[v] = array.copy()
        elif is_image and array.dtype.kind == "f":
            copies[v] = positive_light(array, place)
            most = copies[v].max()
            if most == 255 or (2 < most < 2**16 and (copies[v] % 1 == 0).all()):
                raise ValueError(
                    f"{place} must be linear light with 1 for white where it is floats, got values "
                    f"up to {most:g}, as integers have; pass uint8 in sRGB, or divide linear light "
                    "by 255."
                )
        else:
            raise ValueError(
                f"{place} must be uint8 {list(shape)}, or linear light in floats, got "
                f"{kind_of(array)}; convert it."
            )
    kinds = {kind, *(image.dtype.name for image in copies.values())} - {""}
    if len(kinds) > 1:
        raise ValueError(
            f"push(): frame {frame} must be uint8 (sRGB) for all views, or floats (linear light), "
            f"like the frames before it, got {' and '.join(sorted(kinds))}; convert one of them."
        )
    return copies


def in_order(views: Sequence[View], images: Any, frame: int) -> list[InputImage | None]:
    """Return the images of a frame in the order of the views.

    Raises:
        ValueError: the number of images differs from the number of cameras, or a name does not
            belong to exactly one camera.
    """
    names = [view.name for view in views]
    if isinstance(images, Views):
        images = {view.name: view.image if view.has_image else None for view in images}
    if isinstance(images, Mapping) and all(names.count(name) == 1 for name in images):
        return [images.get(name) for name in names]
    is_sequence = isinstance(images, (Sequence, np.ndarray))
    if not is_sequence or len(images) != len(names):
        content = len(images) if is_sequence else f"a {type(images).__name__}"
        if isinstance(images, Mapping):
            content = f"a dict with {[*images]}; name one camera each of {names}"
        raise ValueError(
            f"push(): frame {frame} must have one image or None for each of {len(names)} views, "
            f"got {content}."
        )
    return list(images)


def image_status(views: Sequence[SeenView]) -> tuple[str, ...]:
    """Return a sentence with advice for each problem of a frame's images.

    Args:
        views: the views that have one.
    """
    plain = []
    cuts = []
    brightest = 0.0
    for each in map_in_threads(_Thumbnails.of, views):
        if _is_plain(each.image):
            plain.append(each.view)
            brightest = max(brightest, each.image.mean())
        elif each.previous is not None and _is_cut(each.previous, each.image):
            cuts.append(each.view)
    sentences = []
    if plain:
        color = "black" if brightest < _BLACK else "of one colour"
        sentences.append(
            f"{_list(plain)}: the image is {color}; cut such frames off the recording, or leave "
            "the camera out (--exclude)"
        )
    if cuts and 2 * len(cuts) >= len(views):
        sentences.append(
            "the images show another scene than in the frame before; end the fit before this "
            "frame (--frames), and fit the rest as another recording"
        )
    elif cuts:
        sentences.append(
            f"{_list(cuts)}: the image shows something else than in the frame before; if the "
            "camera was moved, or its clip has a cut, leave it out (--exclude)"
        )
    return tuple(sentences)


def _list(views: Sequence[SeenView]) -> str:
    return ", ".join(view.name or f"view {view.index}" for view in views)


@dataclass(frozen=True, eq=False)
class _Thumbnails:
    """A view with thumbnails of its images."""

    view: SeenView
    image: np.ndarray  # of its image
    previous: np.ndarray | None  # of the one of the frame before, if there is one

    @classmethod
    def of(cls, view: SeenView) -> _Thumbnails:
        """Return a view with its thumbnails."""
        image = thumbnail(view.image, _WIDTH).astype(np.float64)
        if view.previous is None:
            return cls(view, image, None)
        return cls(view, image, thumbnail(view.previous, _WIDTH).astype(np.float64))


def _is_plain(image: np.ndarray) -> bool:
    """Return whether a thumbnail is of one colour."""
    return bool(image.std((0, 1)).max() < _PLAIN)


def _is_cut(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two thumbnails show different scenes; another exposure, or light after black,
    is no cut.
    """
    if _is_plain(a):
        return False
    a = a - a.mean((0, 1))
    b = b - b.mean((0, 1))
    scale = np.sqrt((a * a).sum() * (b * b).sum())
    change = np.abs(a - b).max(axis=-1) > _CHANGE
    return bool((a * b).sum() < _SAME_SCENE * scale and change.mean() > _LEAST_CHANGED)

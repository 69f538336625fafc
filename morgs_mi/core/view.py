"""A view: a fixed camera, the mask of its pixels, and at one time its image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np

from morgs_mi.core.camera import Camera

NO_IMAGE = np.zeros((0, 0, 3), np.uint8)
"""The image of a view without one."""
# px, shorter side of a reduced image at least.
MIN_SIDE = 32
# Share of the pixels under a reduced one that must be valid; 1 but for rounding.
_ALL_VALID = 0.999


@dataclass(frozen=True, eq=False)
class View:
    """A fixed camera with the mask of its pixels and, at one time, its image.

    Attributes:
        camera: the camera.
        image: [H, W, 3], RGB: uint8 in sRGB, or float32 in the colours of an HDR recording;
            `NO_IMAGE` without one.
        mask: valid pixels [H, W] bool, or None if all are.
        held_out: whether the view is kept from training, as a test of the result.

    Example:
        >>> views = [morgs_mi.View(camera, mask=mask) for camera, mask in zip(cameras, masks)]
        >>> loop = morgs_mi.StreamLoop(views, points, point_colors)
    """

    camera: Camera
    image: np.ndarray = field(default_factory=lambda: NO_IMAGE)
    mask: np.ndarray | None = None
    held_out: bool = False

    @property
    def name(self) -> str:
        """Name of the camera."""
        return self.camera.name

    @property
    def has_image(self) -> bool:
        """Whether the view has an image."""
        return self.image.size > 0

    @property
    def white(self) -> float:
        """Value at which the recording was clipped: 1, or infinity for an HDR recording."""
        return 1.0 if self.image.dtype == np.uint8 else np.inf

    def at(self, image: np.ndarray | None) -> View:
        """Return the view with an image [H, W, 3], or without one."""
        return View(self.camera, NO_IMAGE if image is None else image, self.mask, self.held_out)

    def reduced(self, width: int) -> View:
        """Return the view reduced by the largest whole factor that leaves a width.

        A reduced pixel is valid if all pixels that it covers are.
        """
        factor = self.camera.width // width
        if factor < 2 or self.camera.height // factor < MIN_SIDE:
            return self
        size = (self.camera.width // factor, self.camera.height // factor)
        image = np.asarray(cv2.resize(self.image, size, interpolation=cv2.INTER_AREA))
        mask = self.mask
        if mask is not None:
            share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            mask = share > _ALL_VALID
        return replace(self, camera=self.camera.resized(*size), image=image, mask=mask)


AnyView = TypeVar("AnyView", bound=View)


class Views(tuple[AnyView, ...]):
    """Views of a recording, those for training and those that are held out.

    Example:
        >>> for view in capture.views.train:
        ...     print(view.name, view.camera.size)
    """

    __slots__ = ()

    @property
    def train(self) -> Views[AnyView]:
        """The views that are fitted."""
        return Views(view for view in self if not view.held_out)

    @property
    def test(self) -> Views[AnyView]:
        """The views that are held out from training."""
        return Views(view for view in self if view.held_out)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the views."""
        return tuple(view.camera for view in self)

    def at(self, images: Sequence[np.ndarray | None]) -> Views[View]:
        """Return the views with an image each, or without one."""
        return Views(view.at(image) for view, image in zip(self, images, strict=True))

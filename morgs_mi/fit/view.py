"""Views that Gaussians are fitted to and compared with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import valid_pixels
from morgs_mi.core.color_space import unit_values
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

LEAST_GAIN = 0.1
"""Increase of the PSNR of withheld pixels from which a change of the cameras is taken, dB: less is
chance.
"""

MIN_SIDE = 32  # px, of a reduced image
# Mean squared error of 100 dB.
_LEAST_ERROR = 1e-10
# Least width of views of half the size, px.
COARSE_WIDTH = 160
# Side of the withheld blocks, px.
_BLOCK = 12
# One of so many blocks is withheld.
_SHARE = 8


class View(NamedTuple):
    """A camera and its image."""

    camera: Camera  #: The camera.
    #: [H, W, 3], encoded: uint8, or float32 with values above 1 of an HDR recording.
    image: np.ndarray
    mask: np.ndarray | None = None  #: Valid pixels [H, W] bool, or None if all are.

    @property
    def white(self) -> float:
        """Value at which the recording was clipped: 1, or infinity for an HDR recording."""
        return 1.0 if self.image.dtype == np.uint8 else np.inf

    def reduced(self, width: int) -> View:
        """Return the view reduced by the largest whole factor that leaves a width.

        A reduced pixel is valid if all pixels that it covers are.
        """
        factor = self.camera.width // width
        if factor < 2 or self.camera.height // factor < MIN_SIDE:
            return self
        size = (self.camera.width // factor, self.camera.height // factor)
        image = np.asarray(cv2.resize(self.image, size, interpolation=cv2.INTER_AREA))
        if self.mask is None:
            return View(self.camera.resized(*size), image)
        share = cv2.resize(self.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return View(self.camera.resized(*size), image, share > 0.999)


def half_sized(views: Sequence[View]) -> list[View]:
    """Return views of half the size; a view narrower than 320 px keeps its own."""
    return [view.reduced(max(view.camera.width // 2, COARSE_WIDTH)) for view in views]


def withheld_blocks(
    views: Sequence[View], width: int, rng: np.random.Generator
) -> tuple[list[View], list[View]]:
    """Return the reduced views without withheld blocks of pixels, and with these alone, which may
    be none in a view.

    Args:
        views: V views.
        width: least width of the reduced images, px.
        rng: draws the blocks.
    """
    visible = []
    withheld = []
    for camera, image, mask in (view.reduced(width) for view in views):
        rows, columns = (np.arange(size) // _BLOCK for size in image.shape[:2])
        blocks = rng.random((rows[-1] + 1, columns[-1] + 1)) < 1 / _SHARE
        is_withheld = blocks[rows][:, columns]
        valid = valid_pixels(mask, is_withheld.shape)
        visible.append(View(camera, image, valid & ~is_withheld))
        withheld.append(View(camera, image, valid & is_withheld))
    return visible, withheld


def rendered(
    gaussians: Gaussians, camera: Camera, render: RenderConfig, white: float = 1.0
) -> np.ndarray:
    """Return the encoded image of a camera [H, W, 3], clipped to [0, white]."""
    return np.clip(
        np.asarray(rasterize(gaussians, camera, ("color",), config=render).color), 0, white
    )


def mean_psnr(gaussians: Gaussians, views: Sequence[View], render: RenderConfig) -> float:
    """Return the mean PSNR in dB of views, of their valid pixels; NaN without a valid pixel."""
    errors = []
    for view in views:
        if view.mask is None or view.mask.any():
            image = rendered(gaussians, view.camera, render, view.white)
            squares = ((image - unit_values(view.image)) ** 2).mean(axis=-1)
            errors.append(squares[slice(None) if view.mask is None else view.mask].mean())
    return float(np.mean(decibels(errors))) if errors else np.nan


def decibels(error: ArrayLike) -> Any:
    """Return the PSNR of a mean squared error, at most 100 dB."""
    return -10 * np.log10(np.maximum(error, _LEAST_ERROR))

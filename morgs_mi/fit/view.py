"""Views that Gaussians are fitted to and compared with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import unit_values
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.rig import seen_points
from morgs_mi.core.view import View
from morgs_mi.platform.checks import valid_pixels
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

LEAST_GAIN = 0.1
"""Increase of the PSNR of withheld pixels from which a change of the cameras is taken, dB: less is
chance.
"""

COARSE_WIDTH = 160
"""Least width of views of half the size, px: in smaller ones, Gaussians are pixels."""
SAME_POINT = 0.08
"""Largest difference of the colours of one point in two views."""
# Mean squared error of 100 dB.
_LEAST_ERROR = 1e-10
# Side of the withheld blocks, px: in smaller ones, the pixels around them show what is there.
_BLOCK = 12
# One of so many blocks is withheld: enough for a score, and few for the fit.
_SHARE = 8


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
    for view in views:
        view = view.reduced(width)
        rows = np.arange(view.camera.height) // _BLOCK
        columns = np.arange(view.camera.width) // _BLOCK
        blocks = rng.random((rows[-1] + 1, columns[-1] + 1)) < 1 / _SHARE
        is_withheld = blocks[rows][:, columns]
        valid = valid_pixels(view.mask, is_withheld.shape)
        visible.append(replace(view, mask=valid & ~is_withheld))
        withheld.append(replace(view, mask=valid & is_withheld))
    return visible, withheld


def shares_of(count: int, views: Sequence[View]) -> Iterator[tuple[View, int]]:
    """Yield each of the views with its share of a number of points; the first ones may have one
    more.
    """
    share, rest = divmod(count, max(len(views), 1))
    for k, view in enumerate(views):
        yield view, share + (k < rest)


def random_pixels(
    view: View, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return random positions [count, 2] in the valid pixels of a view, and their colours
    [count, 3], encoded.
    """
    rows, columns = np.nonzero(valid_pixels(view.mask, view.image.shape))
    chosen = rng.integers(0, len(rows), count)
    rows = rows[chosen]
    columns = columns[chosen]
    pixels = np.stack([columns, rows], axis=1) + rng.uniform(0, 1, (count, 2))
    return pixels, unit_values(view.image[rows, columns])


def seen_pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, tuple[Any, ...]]:
    """Return which points [P, 3] lie in a view [P], and the index of their n pixels, which selects
    the values [n, ...] of an image.
    """
    visible, pixels, _ = seen_points(camera, points)
    columns, rows = pixels.astype(int).T
    return visible, (rows, columns)


def shown_colors(view: View, points: np.ndarray) -> np.ndarray:
    """Return the colours [P, 3] in which the valid pixels of a view with an image of floats show
    points [P, 3], NaN where they do not.
    """
    visible, pixels = seen_pixels(view.camera, points)
    is_valid = valid_pixels(view.mask, view.image.shape)[pixels]
    colors = np.full((len(points), 3), np.nan, view.image.dtype)
    colors[visible] = np.where(is_valid[:, None], view.image[pixels], np.nan)
    return colors


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

"""One sweep over the key views: the sums over each Gaussian's pixels that the start of a frame is
found from.

With the blend weights w_i of Gaussian i in view v, the error e = target - image and the target's
gradient g, one rendering and one back-projection of all views together give the sums sum_x w_i(x)
m(x) of the maps

    weight 1,   error |e|,   color e,   normal g g',   right e g

where |e| is the mean over the colours, and products with g are summed over them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import concatenated
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Arrays, Float, Jit, UInt32, Vector2f, Vector3f
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.render.active_view import Drawing, ViewGroup
from morgs_mi.render.backend import elements

_Map = Callable[[Vector3f, Vector3f, Vector3f], Jit]

MAPS: dict[str, _Map] = {
    "weight": lambda e, x, y: [mi.Float(1)],
    "error": lambda e, x, y: [dr.sum(dr.abs(e)) / 3],
    "color": lambda e, x, y: e,
    "normal": lambda e, x, y: [dr.sum(x * x), dr.sum(x * y), dr.sum(y * y)],
    "right": lambda e, x, y: [dr.sum(e * x), dr.sum(e * y)],
}
"""Name of a map -> its numbers at a pixel, from e and the derivatives of the target along x and y,
three colours each.
"""


# Error, in pixels of full contrast, and covered pixels, that are added to every Gaussian's: one
# that is hardly visible has little of either.
_FLOOR_PX = 0.01
_FLOOR_WEIGHT = 1.0


def relative_error(sums: Arrays) -> np.ndarray:
    """Return the mean error of each Gaussian's pixels [N], of 1, from the sums of ``error`` and
    ``weight`` [V, N].
    """
    return (sums["error"].sum(0) + _FLOOR_PX) / (sums["weight"].sum(0) + _FLOOR_WEIGHT)


class KeyImages:
    """Images of key views, which renderings are compared with.

    Args:
        views: V >= 1 active views with their images, by view index.
    """

    def __init__(self, views: Mapping[int, ObservedView]) -> None:
        self.views = views
        self.group = ViewGroup([*views.values()])

    def sums(self, gaussians: Gaussians, names: Sequence[str]) -> Arrays:
        """Return the sums of some `MAPS` per view and Gaussian, float32 [V, N, ...] by name; one
        number has no axis.

        Args:
            gaussians: N Gaussians, detached.
            names: of the maps.
        """
        drawing = self.group.draw(gaussians)
        with dr.suspend_grad():
            error = self._difference(drawing)
            dr.eval(error)
            x = y = error
            if {"normal", "right"} & set(names):
                x, y = self._gradient
            lane = dr.arange(mi.UInt32, self.group.region.num_pixels)
            pixel = [_colors(values, lane) for values in (error, x, y)]
            columns = [MAPS[name](*pixel) for name in names]
            *ends, count = np.cumsum([len(column) for column in columns]).tolist()
            image = dr.empty(mi.Float, dr.width(lane) * count)
            for k, value in enumerate(v for column in columns for v in column):
                dr.scatter(image, value, lane * count + k, mode=dr.ReduceMode.NoConflicts)
            dr.eval(image)
        parts = np.split(drawing.sums(image, count), ends, axis=-1)
        return {
            name: v[..., 0] if v.shape[-1] == 1 else v for name, v in zip(names, parts, strict=True)
        }

    def rendered(self, gaussians: Gaussians, factor: int = 1) -> dict[int, np.ndarray]:
        """Return the image of Gaussians in each view [H // factor, W // factor, 3], by view index;
        0 where the view is not drawn.

        Args:
            gaussians: N Gaussians, detached.
            factor: by which images are reduced; it divides the sides of a block.
        """
        color = np.asarray(self.group.draw(gaussians).color).reshape(self.group.region.shape(3))
        A, height, width, _ = color.shape
        color = color.reshape(A, height // factor, factor, width // factor, factor, 3).mean(
            axis=(2, 4)
        )
        regions = {v: view.drawn for v, view in self.views.items()}
        counts = [region.num_blocks for region in regions.values()]
        parts = np.split(color, np.cumsum(counts)[:-1])
        return {
            v: region.uncropped(part)[: region.height // factor, : region.width // factor]
            for (v, region), part in zip(regions.items(), parts, strict=True)
        }

    def total_error(self, gaussians: Gaussians) -> float:
        """Return the error |e| of Gaussians, summed over all drawn pixels."""
        with dr.suspend_grad():
            return float(dr.sum(dr.abs(self._difference(self.group.draw(gaussians))))[0]) / 3

    def _difference(self, drawing: Drawing) -> Float:
        """Return e, flat [A * block_height * block_width * 3]; 0 where masked."""
        pixels, weights = self._pixels
        return pixels - (drawing.color if weights is None else drawing.color * weights)

    @cached_property
    def _pixels(self) -> tuple[Float, Float | None]:
        """The targets on the group, and the weights of their numbers; None: 1."""
        targets = [view.target.on(view.drawn) for view in self.views.values()]
        pixels = concatenated([numbers for numbers, _ in targets])
        if all(weight is None for _, weight in targets):
            return pixels, None
        weights = [
            dr.full(mi.Float, 1, dr.width(numbers)) if weight is None else weight
            for numbers, weight in targets
        ]
        return pixels, concatenated(weights)

    @cached_property
    def _gradient(self) -> Vector2f:
        """The derivatives of the targets along x and y, per px, flat on the group."""
        return concatenated([view.target.gradient(view.drawn) for view in self.views.values()])


def _colors(values: Float, pixel: UInt32) -> Vector3f:
    """Return the colours of pixels of a flat image."""
    return mi.Vector3f(*(elements(values, 3 * pixel + c) for c in range(3)))

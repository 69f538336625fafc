"""A view, or that part of it where something may change, before what stands still in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import drjit as dr
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.render.backproject import backproject
from morgs_mi.render.blocks import touches
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import Splats, project
from morgs_mi.render.rasterize import Image, rasterize
from morgs_mi.render.region import Region

__all__ = ["ActiveView", "make_active_view"]


@dataclass(frozen=True, eq=False)
class ActiveView:
    """What is looked at when Gaussians are drawn.

    Attributes:
        camera: the view.
        config: cut-offs and block shape.
        region: the blocks of pixels that are drawn; None: the whole view.
        static_splats: what is drawn there besides, and gets no gradients; None: nothing.
    """

    camera: Camera
    config: RenderConfig = field(default_factory=RenderConfig)
    region: Region | None = None
    static_splats: Splats | None = None

    def render(
        self, gaussians: ActivatedGaussians, channels: Sequence[str] = ("color",), detach_weights: Sequence[str] = ()
    ) -> Image:
        """Draw Gaussians through this window, as `rasterize` does."""
        return rasterize(
            gaussians,
            self.camera,
            channels,
            detach_weights=detach_weights,
            region=self.region,
            static_splats=self.static_splats,
            config=self.config,
        )

    def backproject(self, gaussians: ActivatedGaussians, picture: np.ndarray) -> np.ndarray:
        """Return what the window's pixels of a picture, as from `crop`, are worth to each Gaussian [N, C]."""
        return backproject(gaussians, self.camera, picture, self.config, self.region, self.static_splats)

    def crop(self, picture: np.ndarray) -> np.ndarray:
        """Return what a picture [H, W, ...] of the view shows in this window."""
        return picture if self.region is None else self.region.crop(picture)

    @property
    def pixel_fraction(self) -> float:
        """The drawn pixels' share of the view."""
        if self.region is None:
            return 1.0
        width, height = self.region.block
        return min(1.0, self.region.num_blocks * width * height / (self.camera.width * self.camera.height))


def make_active_view(
    camera: Camera, mask: np.ndarray, still: ActivatedGaussians, channels: Sequence[str], config: RenderConfig
) -> ActiveView:
    """Return the window onto the blocks around a mask [H, W], with Gaussians that stand still behind it.

    They are projected here, once: what is drawn in front of them later costs as if they had never moved.

    Args:
        camera: the view.
        mask: bool [H, W], the pixels that will be drawn, at least one.
        still: N >= 0 Gaussians, detached.
        channels: all that will be drawn.
        config: cut-offs and block shape.
    """
    region, blended = Region(mask, config), tuple(name for name in channels if name != "alpha")
    if not int(still.means.shape[0]):
        return ActiveView(camera, config, region)
    with dr.suspend_grad():
        rows = dr.compress(touches(project(still, camera, (), config), region))
        if not dr.width(rows):
            return ActiveView(camera, config, region)
        static_splats = project(still, camera, blended, config, rows)
        dr.eval(
            static_splats.shape,
            static_splats.channels,
            static_splats.depths,
            static_splats.extent,
            static_splats.valid,
            static_splats.finite,
        )
    return ActiveView(camera, config, region, static_splats)

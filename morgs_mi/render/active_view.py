"""Active views: a camera, the blocks of pixels that are drawn, and the static splats behind the active Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import drjit as dr
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.core.types import Tensor
from morgs_mi.render.blocks import touches
from morgs_mi.render.projection import Splats, project
from morgs_mi.render.rasterize import Image, rasterize
from morgs_mi.render.region import Region
from morgs_mi.render.render_config import RenderConfig

__all__ = ["ActiveView", "make_active_view"]


@dataclass(frozen=True, eq=False)
class ActiveView:
    """A view, or its active region, through which Gaussians are rendered.

    Attributes:
        camera: the view.
        config: cut-offs and block shape.
        region: the blocks of pixels that are drawn; None: the whole view.
        static_splats: further splats that are drawn there and get no gradients; None: none.
    """

    camera: Camera
    config: RenderConfig = field(default_factory=RenderConfig)
    region: Region | None = None
    static_splats: Splats | None = None

    def render(
        self,
        gaussians: ActivatedGaussians,
        channels: Sequence[str] = ("color",),
        detach_weights: Sequence[str] = (),
        features: Tensor | None = None,
    ) -> Image:
        """Return the image of Gaussians in this view, see `rasterize`; static splats have features of 0."""
        return rasterize(
            gaussians,
            self.camera,
            channels,
            detach_weights=detach_weights,
            region=self.region,
            features=features,
            static_splats=self.static_splats,
            config=self.config,
        )

    def crop(self, image: np.ndarray) -> np.ndarray:
        """Return the drawn pixels of an image [H, W, ...] of the view."""
        return image if self.region is None else self.region.crop(image)

    def narrowed(self, mask: np.ndarray) -> ActiveView | None:
        """Return the view restricted to drawn blocks with a pixel of `mask` [H, W]; None if there are none."""
        mask = mask if self.region is None else mask & self.region.mask
        return replace(self, region=Region(mask, self.config)) if mask.any() else None

    @property
    def pixel_fraction(self) -> float:
        """Fraction of the view's pixels that is drawn, in [0, 1]."""
        if self.region is None:
            return 1.0
        width, height = self.region.block
        return min(1.0, self.region.num_blocks * width * height / (self.camera.width * self.camera.height))


def make_active_view(
    camera: Camera, mask: np.ndarray, static: ActivatedGaussians, channels: Sequence[str], config: RenderConfig
) -> ActiveView:
    """Return the active view of the blocks that contain a pixel of `mask` [H, W].

    The static Gaussians are projected here, once, and not again when active Gaussians are rendered with them.

    Args:
        camera: the view.
        mask: bool [H, W], the pixels to draw, at least one.
        static: N >= 0 Gaussians, detached.
        channels: all channels that will be rendered.
        config: cut-offs and block shape.
    """
    region, blended = Region(mask, config), tuple(name for name in channels if name != "alpha")
    if not int(static.means.shape[0]):
        return ActiveView(camera, config, region)
    with dr.suspend_grad():
        rows = dr.compress(touches(project(static, camera, (), config), region))
        if not dr.width(rows):
            return ActiveView(camera, config, region)
        static_splats = project(static, camera, blended, config, rows)
        dr.eval(
            static_splats.shape,
            static_splats.channels,
            static_splats.depths,
            static_splats.extent,
            static_splats.valid,
            static_splats.finite,
        )
    return ActiveView(camera, config, region, static_splats)

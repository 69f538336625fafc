"""Active views: a camera, the blocks of pixels that are drawn, and the static splats behind the
active Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Tensor
from morgs_mi.render.backend import block_shape
from morgs_mi.render.blocks import touches
from morgs_mi.render.projection import Splats, project
from morgs_mi.render.rasterize import Image, backdrops, rasterize
from morgs_mi.render.region import BlockGrid, Region
from morgs_mi.render.render_config import RenderConfig


@dataclass(frozen=True, eq=False)
class ActiveView:
    """A view, or its active region, through which Gaussians are rendered."""

    camera: Camera  #: The view.
    config: RenderConfig = field(default_factory=RenderConfig)  #: Cut-offs and block shape.
    region: Region | None = None  #: The blocks of pixels that are drawn; None: the whole view.
    #: Further splats that are drawn there and get no gradients; None: none.
    static_splats: Splats | None = None

    def render(
        self,
        gaussians: ActivatedGaussians,
        channels: Sequence[str] = ("color",),
        detach_weights: Sequence[str] = (),
        features: Tensor | None = None,
    ) -> Image:
        """Return the image of Gaussians in this view, see `rasterize`; static splats have features
        of 0.
        """
        return rasterize(
            gaussians,
            self.camera,
            channels,
            self._background,
            detach_weights=detach_weights,
            region=self.region,
            features=features,
            static_splats=self.static_splats,
            config=self.config,
        )

    @cached_property
    def _background(self) -> Tensor | None:
        """The camera's image behind the drawn pixels; None without one."""
        images = backdrops([self.camera], self.config)
        return None if images is None else from_numpy(mi.TensorXf, self.crop(images[0]))

    def crop(self, image: np.ndarray) -> np.ndarray:
        """Return the drawn pixels of an image [H, W, ...] of the view."""
        return image if self.region is None else self.region.crop(image)

    @property
    def grid(self) -> BlockGrid:
        """All blocks of the view."""
        return BlockGrid(self.camera.width, self.camera.height, block_shape(self.config))

    def narrowed(self, blocks: np.ndarray) -> ActiveView | None:
        """Return the view restricted to some of its drawn blocks, bool [rows, columns]; None if
        there are none.
        """
        blocks = blocks if self.region is None else blocks & self.region.drawn
        return replace(self, region=Region(self.grid, blocks)) if blocks.any() else None


def make_active_view(
    camera: Camera,
    region: Region,
    static: ActivatedGaussians,
    channels: Sequence[str],
    config: RenderConfig,
) -> ActiveView:
    """Return the active view of a region.

    The static Gaussians are projected here, once, and not again when active Gaussians are rendered
    with them.

    Args:
        camera: the view.
        region: the blocks to draw.
        static: N >= 0 Gaussians, detached.
        channels: all channels that will be rendered.
        config: cut-offs and block shape.
    """
    names = tuple(name for name in channels if name != "alpha")
    static_splats = None
    if int(static.means.shape[0]):
        with dr.suspend_grad():
            rows = dr.compress(touches(project(static, camera, (), config), region))
            if dr.width(rows):
                static_splats = project(static, camera, names, config, rows)
                dr.eval(vars(static_splats))
    return ActiveView(camera, config, region, static_splats)

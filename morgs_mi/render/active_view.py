"""Active views: a camera, the blocks of pixels that are drawn, and the static splats behind the
active Gaussians.

Several active views that are drawn by the same launches, without gradients.

A pass over a few small views takes longer to prepare than to compute. So all views share one
region: a lane projects one Gaussian into one view, the lists of all blocks are built together, and
one loop walks them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians, repeat_each
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Float, Tensor, UInt32
from morgs_mi.render.backend import block_shape, elements
from morgs_mi.render.blocks import BlockLists, build_lists, pack_records, touches
from morgs_mi.render.compositing import Layout, blend, record_gradients
from morgs_mi.render.kernel_recording import with_render_lock
from morgs_mi.render.loops import Channel
from morgs_mi.render.projection import Splats, Views, project
from morgs_mi.render.rasterize import Image, backdrops, over, rasterize
from morgs_mi.render.region import BlockGrid, Region, joined, quotient_and_rest
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


class ViewGroup:
    """Active views that are drawn together.

    Images of the group are [A, block_height, block_width, C], the drawn blocks of all views, one
    view after the other.

    Args:
        views: V >= 1 views with the same cut-offs and block shape.

    Attributes:
        views: the views.
        regions: their regions.
        region: the blocks of all of them, see `joined`.
        config: cut-offs and block shape.
    """

    def __init__(self, views: Sequence[ActiveView]) -> None:
        self.views = tuple(views)
        self.regions = tuple(
            view.region
            or Region.of(np.ones((view.camera.height, view.camera.width), bool), view.config)
            for view in views
        )
        self.region = joined(self.regions)
        self.config = self.views[0].config

    def crop(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return an image of the group from one image [H, W, ...] per view."""
        return np.concatenate(
            [region.crop(image) for region, image in zip(self.regions, images, strict=True)]
        )

    @cached_property
    def background(self) -> Sequence[float] | Float | None:
        """Colour [3], or flat image of the group, behind all Gaussians; None: black."""
        images = backdrops([view.camera for view in self.views], self.config)
        if images is None:
            return self.config.background
        return from_numpy(mi.Float, self.crop(images).ravel())

    @with_render_lock
    def draw(self, gaussians: ActivatedGaussians) -> Drawing:
        """Project Gaussians into all views and list those that touch each block.

        Args:
            gaussians: N > 0 Gaussians.
        """
        N = int(gaussians.means.shape[0])
        V = len(self.views)
        cameras = [view.camera for view in self.views]
        with dr.suspend_grad():
            view, row = quotient_and_rest(dr.arange(mi.UInt32, N * V), N)
            lanes = dr.compress(
                touches(project(gaussians, Views(cameras, view), (), self.config, row), self.region)
            )
            splats = self._static
            if dr.width(lanes):
                view, row = quotient_and_rest(lanes, N)
                visible = project(gaussians, Views(cameras, view), ("color",), self.config, row)
                splats = visible if splats is None else visible.concatenated_with(splats)
            if splats is None:
                return Drawing(self, None, lanes, N)
            lists = build_lists(splats, list(splats.channels["color"]), self.region, self.config)
        return Drawing(self, (splats, lists), lanes, N)

    @cached_property
    def _static(self) -> Splats | None:
        """The static splats of all views that touch their regions; None if there are none."""
        splats: Splats | None = None
        for index, view in enumerate(self.views):
            if view.static_splats is not None:
                view_splats = replace(
                    view.static_splats,
                    view=dr.full(mi.UInt32, index, len(view.static_splats)),
                    channels={"color": view.static_splats.channels["color"]},
                )
                splats = view_splats if splats is None else splats.concatenated_with(view_splats)
        if splats is None:
            return None
        rows: Any = dr.compress(touches(splats, self.region))
        if not dr.width(rows):
            return None
        return Splats(**dr.gather(dict, vars(splats), rows))


@dataclass(frozen=True, eq=False)
class Drawing:
    """Gaussians in the views of a group."""

    group: ViewGroup  #: The views.
    #: The projected Gaussians that touch the group's blocks, with the static splats after them, and
    #: the lists of the blocks; None if there are no splats.
    drawn: tuple[Splats, BlockLists] | None
    lanes: UInt32  #: (view * N + Gaussian) of the splats that are not static, ascending.
    count: int  #: N.

    @cached_property
    def color(self) -> Float:
        """Colour of the group's pixels, flat [A * block_height * block_width * 3]; 0 outside the
        views.
        """
        behind = self.group.background
        image = dr.zeros(mi.Float, 3 * self.group.region.num_pixels)
        weight = [dr.zeros(mi.Float, self.group.region.num_pixels)]
        with dr.suspend_grad():
            if self.drawn is not None:
                splats, lists = self.drawn
                layout = Layout((Channel(3, True),), behind is not None, False, self.group.config)
                image, *weight = blend(
                    splats.geometry, [splats.channels["color"]], self.group.region, lists, layout
                )
            if behind is not None:
                image = over(behind, image, repeat_each(weight[0], 3))
            if self.group.region.weights is not None:
                image = image * repeat_each(self.group.region.weights, 3)
            dr.eval(image)
        return image

    def sums(self, image: Float, channels: int) -> np.ndarray:
        """Return the sums of an image's pixels by blend weight, per view and Gaussian, float32
        [V, N, C].

        Args:
            image: flat image of the group [A * block_height * block_width * C].
            channels: C.
        """
        sums = np.zeros((len(self.group.views) * self.count, channels), np.float32)
        lanes = np.asarray(self.lanes)
        if len(lanes):
            sums[lanes] = np.stack(self._sums(image, channels), axis=1)
        return sums.reshape(-1, self.count, channels)

    def totals(self, image: Float, channels: int) -> np.ndarray:
        """Return the sums of an image's pixels by blend weight over all views, float32 [N, C]; see
        `sums`.
        """
        if not dr.width(self.lanes):
            return np.zeros((self.count, channels), np.float32)
        rows = np.asarray(self.lanes) % self.count
        totals = [np.bincount(rows, sums, self.count) for sums in self._sums(image, channels)]
        return np.stack(totals, axis=1).astype(np.float32)

    @with_render_lock
    def _sums(self, image: Float, channels: int) -> list[Float]:
        """Return the sums of each channel, one per lane."""
        assert self.drawn is not None
        splats, lists = self.drawn
        with dr.suspend_grad():
            columns = [dr.zeros(mi.Float, len(splats)) for _ in range(channels)]
            records = pack_records([*splats.geometry, *columns], lists.depth_order_of)
            layout = Layout((Channel(channels, False),), False, False, self.group.config)
            grads = record_gradients(replace(lists, records=records), layout, [image], [image])
            place = dr.arange(mi.UInt32, dr.width(self.lanes))  # static splats come after
            lane_sums = [elements(grad, place) for grad in grads]
            dr.eval(lane_sums)
        return lane_sums


def backproject(gaussians: ActivatedGaussians, view: ActiveView, image: np.ndarray) -> np.ndarray:
    """Return sum_x w_i(x) image(x) for every Gaussian i, with the weights w_i = T_i alpha_i of
    eq. 1.

    This is the transpose of blending: the renderer's channel adjoint with the image in place of a
    gradient.

    Args:
        gaussians: N > 0 Gaussians.
        view: the view; its static splats are blended with the Gaussians and receive no sum.
        image: [H, W, C], or of the view's region as by `ActiveView.crop`.

    Returns:
        float32 [N, C].
    """
    group = ViewGroup([view])
    blocks = group.crop([image]) if view.region is None else image
    return group.draw(gaussians).sums(from_numpy(mi.Float, blocks), image.shape[-1])[0]

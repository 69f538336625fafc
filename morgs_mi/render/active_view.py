"""Active views: a camera, the blocks of pixels that are drawn, and the static splats behind the
active Gaussians.

Several active views that are drawn by the same launches, without gradients.

A pass over a few small views takes longer to prepare than to compute. So all views share one
region: a lane projects one Gaussian into one view, the lists of all blocks are built together, and
one loop walks them all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.camera import OF_SENSOR, Camera
from morgs_mi.core.gaussians import ActivatedGaussians, repeat_each
from morgs_mi.core.types import Float, Tensor, UInt32
from morgs_mi.platform.checks import check_type, require
from morgs_mi.render.background import backdrops, over
from morgs_mi.render.blocks import BlockLists, build_lists, pack_records, touches
from morgs_mi.render.compositing import Layout, blend, record_gradients
from morgs_mi.render.kernel_recording import with_render_lock
from morgs_mi.render.loops import Channel
from morgs_mi.render.projection import Splats, TracedCameras, project
from morgs_mi.render.region import BlockGrid, Region, joined, quotient_and_rest
from morgs_mi.render.render_config import RenderConfig


@dataclass(frozen=True, eq=False)
class StaticSplats:
    """Static splats of one view: a range of the static splats of several views."""

    together: Splats  #: Of all these views, which are projected at once.
    first: int  #: Index of the view's first one.
    count: int  #: Number of the view's.

    def __len__(self) -> int:
        return self.count

    @cached_property
    def alone(self) -> Splats:
        """The view's splats."""
        with dr.suspend_grad():
            lane = dr.arange(mi.UInt32, self.count) + opaque(mi.UInt32, self.first)
            splats = self.together.at(lane)
            dr.eval(splats)
        return splats


@dataclass(frozen=True, eq=False)
class ActiveView:
    """A view, or its active region, through which Gaussians are rendered (see `render_view`).

    Raises:
        ValueError: an argument of another type, or a region of another view or block shape.
    """

    camera: Camera  #: The view.
    config: RenderConfig = field(default_factory=RenderConfig)  #: Cut-offs and block shape.
    region: Region | None = None  #: The blocks of pixels that are drawn; None: the whole view.
    #: Further splats that are drawn there and get no gradients; None: none.
    static_splats: StaticSplats | None = None

    def __post_init__(self) -> None:
        place = "ActiveView()"
        check_type(place, "camera", self.camera, Camera, OF_SENSOR)
        check_type(place, "config", self.config, RenderConfig)
        if self.static_splats is not None:
            check_type(place, "static_splats", self.static_splats, StaticSplats)
        if self.region is not None:
            check_type(place, "region", self.region, Region)
            require(
                self.region.grid == self.grid,
                place,
                f"`region` must be of {self.grid} like the camera's and the config's",
                f"one of {self.region.grid}",
                "build it for this camera with this config",
            )

    @cached_property
    def background(self) -> Sequence[float] | Tensor | None:
        """The camera's image behind the drawn pixels, or the colour of the config."""
        images = backdrops([self.camera], self.config)
        if images is None:
            return self.config.background
        return from_numpy(mi.TensorXf, self.crop(images[0]))

    def crop(self, image: np.ndarray) -> np.ndarray:
        """Return the drawn pixels of an image [H, W, ...] of the view."""
        return image if self.region is None else self.region.crop(image)

    @property
    def grid(self) -> BlockGrid:
        """All blocks of the view."""
        return BlockGrid.of(self.camera, self.config)

    @cached_property
    def drawn(self) -> Region:
        """The blocks that are drawn, as a region also if they are the whole view."""
        if self.region is not None:
            return self.region
        return Region.of(np.ones((self.camera.height, self.camera.width), bool), self.config)


AnyActiveView = TypeVar("AnyActiveView", bound=ActiveView)


def narrowed(views: Mapping[int, AnyActiveView], blocks: np.ndarray) -> dict[int, AnyActiveView]:
    """Return views restricted to some of their drawn blocks, without those that have none left.

    Args:
        views: V views, by view index.
        blocks: bool [V, rows, columns], of which a smaller view has the first ones (see `stacked`).
    """
    result = {}
    for (v, view), requested in zip(views.items(), blocks, strict=True):
        rows, columns = view.grid.shape
        requested = requested[:rows, :columns]
        if view.region is not None:
            requested = requested & view.region.drawn
        if requested.any():
            result[v] = replace(view, region=Region(view.grid, requested))
    return result


class ViewGroup:
    """Active views that are drawn together.

    Images of the group are [A, block_height, block_width, C], the drawn blocks of all views, one
    view after the other.

    Args:
        views: V >= 1 views with the same cut-offs and block shape.

    Attributes:
        views: the views.
        region: the blocks of all of them, see `joined`.
        config: cut-offs and block shape.
    """

    def __init__(self, views: Sequence[ActiveView]) -> None:
        self.views = tuple(views)
        self.region = joined([view.drawn for view in views])
        self.config = self.views[0].config

    def crop(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return an image of the group from one image [H, W, ...] per view."""
        return np.concatenate(
            [view.drawn.crop(image) for view, image in zip(self.views, images, strict=True)]
        )

    @cached_property
    def background(self) -> Sequence[float] | Float | None:
        """Colour [3], or flat image of the group, behind all Gaussians; None: black."""
        images = backdrops([view.camera for view in self.views], self.config)
        if images is None:
            return self.config.background
        return from_numpy(mi.Float, self.crop(images).ravel())

    @cached_property
    def _cameras(self) -> TracedCameras:
        """The cameras of the views."""
        return TracedCameras.of([view.camera for view in self.views])

    def _touching(self, gaussians: ActivatedGaussians) -> UInt32:
        """Return (view * N + Gaussian), ascending, of each of N > 0 Gaussians in each view that has
        a block that it touches.
        """
        N = int(gaussians.means.shape[0])
        with dr.suspend_grad():
            view, row = quotient_and_rest(dr.arange(mi.UInt32, N * len(self.views)), N)
            splats = project(gaussians, self._cameras.of_each(view), (), self.config, row)
            return dr.compress(touches(splats, self.region))

    def with_static(
        self, static: ActivatedGaussians, channels: Sequence[str]
    ) -> tuple[ActiveView, ...]:
        """Return the views, each with the static Gaussians that touch its region behind the active
        ones.

        They are projected here, once, into all views together.

        Args:
            static: N Gaussians, detached.
            channels: all channels that will be rendered in any view.
        """
        N = int(static.means.shape[0])
        lanes = np.asarray(self._touching(static)) if N else np.arange(0)
        if not len(lanes):
            return self.views
        with dr.suspend_grad():
            view, row = quotient_and_rest(from_numpy(mi.UInt32, lanes), N)
            camera = self._cameras.of_each(view)
            splats = project(static, camera, tuple(channels), self.config, row)
            splats = replace(splats, view=None)
            dr.make_opaque(splats)
        firsts = np.searchsorted(lanes, N * np.arange(len(self.views) + 1))
        views = [*self.views]
        for v in np.flatnonzero(np.diff(firsts)).tolist():
            part = StaticSplats(splats, int(firsts[v]), int(firsts[v + 1] - firsts[v]))
            views[v] = replace(views[v], static_splats=part)
        return tuple(views)

    @with_render_lock
    def draw(self, gaussians: ActivatedGaussians) -> Drawing:
        """Project Gaussians into all views and list those that touch each block.

        Args:
            gaussians: N > 0 Gaussians.
        """
        N = int(gaussians.means.shape[0])
        with dr.suspend_grad():
            lanes = self._touching(gaussians)
            splats = self._static
            if dr.width(lanes):
                view, row = quotient_and_rest(lanes, N)
                camera = self._cameras.of_each(view)
                visible = project(gaussians, camera, ("color",), self.config, row)
                splats = visible if splats is None else visible.concatenated_with(splats)
            if splats is None:
                return Drawing(self, None, lanes, N)
            lists = build_lists(splats, splats.columns(("color",)), self.region, self.config)
        return Drawing(self, (splats, lists), lanes, N)

    @cached_property
    def _static(self) -> Splats | None:
        """The static splats of all views that touch their regions; None if there are none."""
        parts = [
            replace(
                view.static_splats.alone,
                view=dr.full(mi.UInt32, index, len(view.static_splats)),
                channels={"color": view.static_splats.alone.channels["color"]},
            )
            for index, view in enumerate(self.views)
            if view.static_splats is not None
        ]
        if not parts:
            return None
        splats = parts[0].concatenated_with(*parts[1:])
        dr.eval(splats)  # one kernel, not one for each column that is read below
        rows: Any = dr.compress(touches(splats, self.region))
        if not dr.width(rows):
            return None
        return splats.at(rows)


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
                values = [*splats.geometry, *splats.columns(("color",))]
                image, *weight = blend(values, self.group.region, lists, layout)
            if behind is not None:
                image = over(behind, image, repeat_each(weight[0], 3))
            image = self.group.region.within_view(image, 3)
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
            sums[lanes] = self._sums(image, channels)
        return sums.reshape(-1, self.count, channels)

    def totals(self, image: Float, channels: int) -> np.ndarray:
        """Return the sums of an image's pixels by blend weight over all views, float32 [N, C]; see
        `sums`.
        """
        if not dr.width(self.lanes):
            return np.zeros((self.count, channels), np.float32)
        rows = np.asarray(self.lanes) % self.count
        totals = [np.bincount(rows, sums, self.count) for sums in self._sums(image, channels).T]
        return np.stack(totals, axis=1).astype(np.float32)

    @with_render_lock
    def _sums(self, image: Float, channels: int) -> np.ndarray:
        """Return the sums of each lane, float32 [L, C]."""
        assert self.drawn is not None
        splats, lists = self.drawn
        with dr.suspend_grad():
            columns = [dr.zeros(mi.Float, len(splats)) for _ in range(channels)]
            records = pack_records([*splats.geometry, *columns], lists.depth_order_of)
            layout = Layout((Channel(channels, False),), False, False, self.group.config)
            lane_sums = record_gradients(
                self.group.region,
                replace(lists, records=records),
                layout,
                [image],
                [image],
                dr.width(self.lanes),  # static splats come after
            )
            lane = dr.arange(mi.UInt32, dr.width(self.lanes)) * channels
            sums = dr.empty(mi.Float, dr.width(lane) * channels)
            for k, values in enumerate(lane_sums):
                dr.scatter(sums, values, lane + k, mode=dr.ReduceMode.NoConflicts)
        return np.asarray(sums).reshape(-1, channels)


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

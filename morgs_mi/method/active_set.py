"""The active set of a frame: the Gaussians that may change, and the pixels of the views where they
are visible.

A Gaussian is active if its responsibility for the changes of all views and its overlap with them
exceed thresholds (see `responsibility`), or if it moved in the previous frame, because its
confidence must be able to fall. A view is rendered where an active Gaussian is visible or the image
changed. Active Gaussians that hardly changed are rendered only in some views, spread over the rig,
which suffice to hold them in place. All other Gaussians are static splats.

An object that appears in front of a static background hides a different part of it in each view,
and no Gaussian is responsible. If active Gaussians cover less than half of a connected change, the
Gaussians that lie in it by more than half are active.

Responsibility and overlap of a Gaussian: how much of its visible surface changed, and in how
many of the views.

With the change mask c_v of view v and the blend weights w_iv(x) of frame t-1's Gaussians,

    r_i = sum_v sum_x w_iv c_v / sum_v sum_x w_iv .

A hidden Gaussian has no weight and is not responsible; one that something passes in front of in two
of twenty views is hardly so. Rendering all views to learn the denominator would cost more than the
rest of a frame. So only the blocks R_v of pixels with changes are rendered, and a Gaussian counts
as equally visible elsewhere: with its boxes b_iv,

    r_i = (sum_v sum_{R_v} w_iv c_v / sum_v sum_{R_v} w_iv) (sum_v |b_iv and R_v| / sum_v |b_iv|) .

Large views are rendered at a fraction of their resolution, where c_v is the changed share of a
pixel.

A wall behind moving objects changes at their edges, in those views in which they are in front of
it. What moves itself lies within the changes of all views V_i in which it is, hidden or not. The
overlap is the mean over these views,

    o_i = 1/|V_i| sum_{v in V_i} |b_iv and R_v| / |b_iv| .
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import prod

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians, at_rest
from morgs_mi.core.rig import choose_key_views
from morgs_mi.core.view import View
from morgs_mi.method.boxes import Boxes, boxes_around
from morgs_mi.render.active_view import ActiveView, ViewGroup, narrowed
from morgs_mi.render.backend import block_shape
from morgs_mi.render.region import BlockGrid, Region, stacked
from morgs_mi.render.render_config import RenderConfig

# Fraction of a connected change that active Gaussians must cover to explain it.
EXPLAINED = 0.5
# Half side of the box, as a fraction of the Gaussian's extent: two standard deviations of an opaque
# one. Its extent reaches the alpha cut-off at three and a third.
_CORE = 0.6
# Overlap above which a Gaussian is active: walls behind moving objects have less, what moves more.
_MIN_OVERLAP = 0.35
# Responsibility above which a Gaussian is active: of noise and of neighbours that move, it is less.
MIN_RESPONSIBILITY = 0.05
# Blend weight in changed blocks, summed over all views in px, below which a Gaussian counts as
# hidden. One inside an object that moves is nearly hidden: it would stay behind, and be uncovered
# later.
MIN_WEIGHT = 0.2
# Responsibility below which an active Gaussian hardly changes.
QUIET = 0.2
# Number of views in which such Gaussians are rendered: in all 27 of basketball, a tenth more pixels
# would be drawn.
QUIET_VIEWS = 12


@dataclass(frozen=True, eq=False)
class ChangedView(View):
    """A view with the pixels that have changed since the frame before."""

    change: np.ndarray = field(kw_only=True)  #: Mask of these pixels, bool [H, W].


@dataclass(frozen=True, eq=False)
class ChangedViews:
    """V views, their changed pixels and the Gaussians in them."""

    views: Sequence[ChangedView]  #: The views.
    render: RenderConfig  #: Cut-offs.
    boxes: Boxes  #: Boxes of the N Gaussians.

    @classmethod
    def of(
        cls, gaussians: Gaussians, views: Sequence[ChangedView], render: RenderConfig
    ) -> ChangedViews:
        """Return the views with the boxes of N >= 1 Gaussians."""
        cameras = [view.camera for view in views]
        return cls(views, render, boxes_around(gaussians, cameras, render, _CORE))

    @cached_property
    def counts(self) -> np.ndarray:
        """Number of changed pixels of each block, int32 [V, rows, columns], see `stacked`."""
        return stacked(
            [BlockGrid.of(view.camera, self.render).counts(view.change) for view in self.views]
        )


@dataclass(frozen=True, eq=False)
class _ReducedView:
    """A changed view at a fraction of its resolution."""

    camera: Camera  # of the reduced size
    share: np.ndarray  # changed share of each pixel [h, w]
    blocks: np.ndarray  # those with changes, bool [rows, columns]
    factor: int  # by which the view is reduced

    @classmethod
    def of(cls, view: ChangedView, width: int, render: RenderConfig) -> _ReducedView:
        """Return a view, reduced by the largest whole factor that leaves a width in px."""
        factor = max(view.camera.width // width, 1)
        size = (max(view.camera.width // factor, 1), max(view.camera.height // factor, 1))
        change = 255 * view.change.astype(np.uint8)
        share = cv2.resize(change, size, interpolation=cv2.INTER_AREA)
        camera = view.camera.resized(*size)
        blocks = BlockGrid.of(camera, render).counts(share > 0) > 0
        return cls(camera, share / np.float32(255), blocks, factor)

    def drawn(self, render: RenderConfig) -> ActiveView:
        """Return the view of the blocks with changes."""
        region = Region(BlockGrid.of(self.camera, render), self.blocks)
        return ActiveView(self.camera, render, region)


def responsibility(
    gaussians: Gaussians, changed_views: ChangedViews, width: int = 640
) -> np.ndarray:
    """Return the responsibility r [N] of each Gaussian for the changes, from 0 to 1; 0 for hidden
    ones.

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        changed_views: V views with the boxes of these Gaussians.
        width: views are reduced by the largest whole factor that leaves this width, in px.
    """
    render = changed_views.render
    reduced = [_ReducedView.of(view, width, render) for view in changed_views.views]
    changed = [view for view in reduced if view.blocks.any()]
    if not changed:
        return np.zeros(len(gaussians), np.float32)
    # Blend weights summed over changed pixels, and over all in their blocks, in px of the view.
    group = ViewGroup([view.drawn(render) for view in changed])
    areas = [np.full(np.count_nonzero(view.blocks), view.factor**2) for view in changed]
    pixel_area = np.concatenate(areas)[:, None, None]
    share = group.crop([view.share for view in changed])
    maps = np.stack([pixel_area * share, np.broadcast_to(pixel_area, share.shape)], axis=-1)
    change_weight, weight = group.draw(gaussians).totals(from_numpy(mi.Float, maps), 2).T
    visible = weight > MIN_WEIGHT
    # At least 1: the box of a Gaussian beside the view may be empty, although it reaches into the
    # view.
    boxes = changed_views.boxes
    area = boxes.total(boxes.area)
    sides = np.outer([view.factor for view in reduced], block_shape(render))
    blocks = stacked([view.blocks for view in reduced])
    near = boxes.total(boxes.within(blocks, sides))
    area_ratio = np.maximum(np.asarray(area / dr.maximum(near, 1)), 1)
    return visible * change_weight / np.maximum(weight * area_ratio, 1e-30)


def overlap(changed_views: ChangedViews) -> np.ndarray:
    """Return the overlap o [N] of each Gaussian with the changes, from 0 to 1; 0 for one that is in
    no view.
    """
    boxes = changed_views.boxes
    near = boxes.within(changed_views.counts > 0, boxes.sides)
    shares = boxes.total(near / dr.maximum(boxes.area, 1))
    counts = boxes.total(dr.select(boxes.area > 0, mi.Float(1), 0))
    return np.asarray(shares / dr.maximum(counts, 1))


@dataclass(frozen=True, eq=False)
class ActiveSet:
    """The Gaussians and pixels that take part in a frame."""

    indices: np.ndarray  #: int [M], ascending: the active Gaussians among N.
    num_gaussians: int  #: N.
    views: Mapping[int, ActiveView]  #: Active views in which they are visible, by view index.
    num_views: int  #: V, the views that have an image.

    def select(self, gaussians: Gaussians) -> Gaussians:
        """Return the active ones among N Gaussians."""
        return gaussians if len(self.indices) == len(gaussians) else gaussians.select(self.indices)

    @property
    def _static(self) -> np.ndarray:
        """Indices of the static Gaussians [N - M]."""
        return np.setdiff1d(np.arange(self.num_gaussians), self.indices, assume_unique=True)

    def with_static(self, gaussians: Gaussians, channels: Sequence[str]) -> ActiveSet:
        """Return the set with the static ones among N Gaussians behind the active ones in its
        views.

        Args:
            gaussians: of the previous frame, detached.
            channels: all channels that will be rendered in any view.
        """
        if not self.views:
            return self
        static = at_rest(gaussians.select(self._static))
        views = ViewGroup([*self.views.values()]).with_static(static, channels)
        return replace(self, views=dict(zip(self.views, views, strict=True)))

    def merge(
        self, previous: Gaussians, gaussians: Gaussians, source: np.ndarray
    ) -> tuple[Gaussians, np.ndarray]:
        """Return active Gaussians after a fit among the static ones, which have not moved.

        Args:
            previous: N Gaussians before the fit.
            gaussians: the active ones after it, detached.
            source: int, index of each among the active ones before it; -1 for births, which come
                last.

        Returns:
            The Gaussians in the order of the previous frame, and their index in it; births have -1.
        """
        if len(self.indices) == len(previous):
            return gaussians, source
        static = self._static
        index = np.where(source < 0, len(previous), self.indices[source])
        previous_index = np.concatenate([static, index])
        order = np.argsort(previous_index, kind="stable")  # births come last
        merged = Gaussians.concatenate([at_rest(previous.select(static)), gaussians])
        merged_source = np.where(previous_index < len(previous), previous_index, -1)
        return merged.select(order), merged_source[order]

    @property
    def fractions(self) -> dict[str, float]:
        """Fractions of the Gaussians, of the views and of all their pixels that are active, from 0
        to 1.
        """
        pixels = 0.0
        for view in self.views.values():
            size = view.camera.width * view.camera.height
            drawn = (
                size if view.region is None else view.region.num_blocks * prod(view.region.block)
            )
            pixels += min(1.0, drawn / size)
        return {
            "gaussians": len(self.indices) / max(self.num_gaussians, 1),
            "views": len(self.views) / max(self.num_views, 1),
            "pixels": pixels / max(self.num_views, 1),
        }


def full_active_set(
    gaussians: Gaussians, cameras: Mapping[int, Camera], render: RenderConfig
) -> ActiveSet:
    """Return the active set of all Gaussians and of all pixels of the cameras, by view index."""
    views = {view: ActiveView(camera, render) for view, camera in cameras.items()}
    return ActiveSet(np.arange(len(gaussians)), len(gaussians), views, len(cameras))


def find_active_set(
    gaussians: Gaussians,
    views: Mapping[int, ChangedView],
    render: RenderConfig,
) -> ActiveSet:
    """Return the active set of a frame (see the module), without static splats.

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        views: V views with their changed pixels, by view index.
        render: cut-offs.
    """
    if not views:
        return ActiveSet(np.arange(0), len(gaussians), {}, 0)
    cameras = {v: view.camera for v, view in views.items()}
    changed_views = ChangedViews.of(gaussians, [*views.values()], render)
    shares = responsibility(gaussians, changed_views)
    active = shares > MIN_RESPONSIBILITY
    active &= overlap(changed_views) > _MIN_OVERLAP
    if gaussians.logit_confidence is not None:
        active |= np.asarray(gaussians.logit_confidence) > 0
    active |= _inside_unexplained(changed_views, active)
    # Those that hardly change are drawn in some views only.
    drawn = np.tile(active & (shares > QUIET), (len(views), 1))
    drawn[[*choose_key_views([*cameras.values()], QUIET_VIEWS)]] = active
    blocks = changed_views.boxes.union(drawn) | (changed_views.counts > 0)
    active_views = narrowed(full_active_set(gaussians, cameras, render).views, blocks)
    return ActiveSet(np.flatnonzero(active), len(gaussians), active_views, len(cameras))


def _inside_unexplained(changed_views: ChangedViews, active: np.ndarray) -> np.ndarray:
    """Return the Gaussians that lie by more than half in connected changes of which active ones
    cover less than half, bool [N]; those of a view count as active in the next ones.
    """
    boxes = changed_views.boxes
    additions = np.zeros_like(active)
    covered = boxes.union(active)
    for v, counts in enumerate(changed_views.counts):
        missing = _unexplained(counts, covered[v])
        if missing.any():
            some = boxes.of_view(v)
            additions |= np.asarray(some.within(missing[None], some.sides) > 0.5 * some.area)
            covered = boxes.union(active | additions)
    return additions


def _unexplained(counts: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Return the blocks of the connected changes of a view that are covered by less than half, bool
    [rows, columns].

    Args:
        counts: number of changed pixels of each block.
        covered: the blocks that active Gaussians cover.
    """
    changes = counts > 0
    count, labels = cv2.connectedComponents(changes.astype(np.uint8))
    area = np.bincount(labels[changes], counts[changes], count)
    covered &= changes
    covered_area = np.bincount(labels[covered], counts[covered], count)
    missing = covered_area < EXPLAINED * area
    missing[0] = False
    return missing[np.asarray(labels, np.int32)]

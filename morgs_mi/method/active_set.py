"""The active set of a frame: the Gaussians that may change, and the pixels of the views where they
are visible.

A Gaussian is active if its responsibility for the changes of all views and its overlap with them
exceed thresholds (see `responsibility`), or if it moved in the previous frame, because its
confidence must be able to fall. A view is rendered where an active Gaussian is visible or the image
changed. Active Gaussians that hardly changed are rendered only in some views, spread over the rig,
which suffice to hold them in place. All other Gaussians are static splats.

An object that appears in front of a static background hides a different part of it in each view,
and no Gaussian is responsible. If active Gaussians cover less than half of a connected change, the
Gaussians that lie in it by more than half are active. If more than half of all pixels changed, all
Gaussians are active: leaving out the others would cost more than it saves.

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

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.config import Count, NonNegative, config_class
from morgs_mi.core.gaussians import Gaussians, at_rest
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.rig import choose_key_views
from morgs_mi.method.boxes import Boxes, boxes_around
from morgs_mi.render.active_view import ActiveView, ViewGroup, make_active_view
from morgs_mi.render.region import Region, summed_area
from morgs_mi.render.render_config import RenderConfig


@dataclass(frozen=True, eq=False)
class ChangedView:
    """A view, its changed pixels and the Gaussians in it."""

    view: ActiveView  #: The whole view.
    change: np.ndarray  #: Mask of the changed pixels, bool [H, W].
    boxes: Boxes  #: Boxes of the N Gaussians.

    @cached_property
    def counts(self) -> np.ndarray:
        """Number of changed pixels of each block, int32 [rows, columns]."""
        return self.view.grid.counts(self.change)


def responsibility(
    gaussians: Gaussians, views: Iterable[ChangedView], min_weight: float, width: int = 640
) -> np.ndarray:
    """Return the responsibility r [N] of each Gaussian for the changes, from 0 to 1; 0 for hidden
    ones.

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        views: V views with the boxes of these Gaussians.
        min_weight: blend weight summed over all changed blocks, in px, below which a Gaussian
            counts as hidden.
        width: views are reduced by the largest whole factor that leaves this width, in px.
    """
    near = dr.zeros(mi.Float, len(gaussians))
    area = dr.zeros(mi.Float, len(gaussians))
    views_with_changes = []
    shares = []
    factors = []
    for changed_view in views:
        boxes = changed_view.boxes
        area += boxes.area
        dr.eval(near, area)  # one kernel for all views
        if not changed_view.change.any():
            continue
        view = changed_view.view
        factor = max(view.camera.width // width, 1)
        h, w = (max(size // factor, 1) for size in changed_view.change.shape)
        change = 255 * changed_view.change.astype(np.uint8)
        share = cv2.resize(change, (w, h), interpolation=cv2.INTER_AREA)
        region = Region.of(share > 0, view.config)
        near += boxes.within(region.block_table, region.grid, factor)
        views_with_changes.append(ActiveView(view.camera.resized(w, h), view.config, region))
        shares.append(share / np.float32(255))
        factors.append(factor)
    if not factors:
        return np.zeros(len(gaussians), np.float32)
    # Blend weights summed over changed pixels, and over all in their blocks, in px of the view.
    group = ViewGroup(views_with_changes)
    blocks = [region.num_blocks for region in group.regions]
    pixel_area = np.repeat(np.square(factors), blocks)[:, None, None]
    share = group.crop(shares)
    maps = np.stack([pixel_area * share, np.broadcast_to(pixel_area, share.shape)], axis=-1)
    change_weight, weight = group.draw(gaussians).totals(from_numpy(mi.Float, maps), 2).T
    visible = weight > min_weight
    # At least 1: the box of a Gaussian beside the view may be empty, although it reaches into the
    # view.
    area_ratio = np.maximum(np.asarray(area / dr.maximum(near, 1)), 1)
    return visible * change_weight / np.maximum(weight * area_ratio, 1e-30)


def overlap(count: int, views: Iterable[ChangedView]) -> np.ndarray:
    """Return the overlap o [N] of `count` Gaussians with the changes, from 0 to 1; 0 for one that
    is in no view.
    """
    shares = dr.zeros(mi.Float, count)
    counts = dr.zeros(mi.Float, count)
    for changed_view in views:
        boxes = changed_view.boxes
        counts += dr.select(boxes.area > 0, 1, 0)
        if changed_view.change.any():
            table = from_numpy(mi.UInt32, summed_area(changed_view.counts > 0))
            shares += boxes.within(table, changed_view.view.grid) / dr.maximum(boxes.area, 1)
        dr.eval(shares, counts)  # one kernel for all views
    return np.asarray(shares / dr.maximum(counts, 1))


# Fraction of a connected change that active Gaussians must cover to explain it.
EXPLAINED = 0.5
# Fraction of a block's pixels above which it belongs to a connected change: fewer are noise, or the
# rim of one.
_CHANGED = 0.25
# Fraction of all pixels above which all Gaussians are active: leaving out the others would cost
# more than it saves.
_MOST_CHANGED = 0.5
# Half side of the box, as a fraction of the Gaussian's extent: two standard deviations of an opaque
# one. Its extent reaches the alpha cut-off at three and a third.
_CORE = 0.6
# Overlap above which a Gaussian is active: walls behind moving objects have less, what moves more.
_MIN_OVERLAP = 0.35
# Responsibility below which an active Gaussian is rendered in `quiet_views` only.
QUIET = 0.2


@config_class
class ActiveSetConfig:
    """Settings of the selection, see the module."""

    min_responsibility: NonNegative = 0.05
    """Responsibility above which a Gaussian is active."""
    min_weight: NonNegative = 0.2
    """Blend weight in changed blocks, summed over all views in px, below which a Gaussian counts as
    hidden. One inside an object that moves is nearly hidden: it would stay behind, and be uncovered
    later."""
    quiet_views: Count = 12
    """Number of views in which active Gaussians that hardly change are rendered."""


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
        is_static = np.ones(len(previous), bool)
        is_static[self.indices] = False
        static = np.flatnonzero(is_static)
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
    cameras: Mapping[int, Camera],
    changes: Mapping[int, np.ndarray] | None,
    channels: Mapping[int, Sequence[str]],
    render: RenderConfig,
    config: ActiveSetConfig,
) -> ActiveSet:
    """Return the active set of a frame (see the module).

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        cameras: V cameras, by view index.
        changes: masks of their changed pixels, bool [H, W], by view index; None: all may have
            changed.
        channels: channels that will be rendered, by view index.
        render: cut-offs.
        config: settings.
    """
    if changes is None or sum(c.mean() for c in changes.values()) > _MOST_CHANGED * len(cameras):
        return full_active_set(gaussians, cameras, render)
    changed_views = {
        v: ChangedView(
            ActiveView(camera, render), changes[v], boxes_around(gaussians, camera, render, _CORE)
        )
        for v, camera in cameras.items()
    }
    shares = responsibility(gaussians, changed_views.values(), config.min_weight)
    active = shares > config.min_responsibility
    active &= overlap(len(gaussians), changed_views.values()) > _MIN_OVERLAP
    if gaussians.logit_confidence is not None:
        active |= np.asarray(gaussians.logit_confidence) > 0
    for view in changed_views.values():
        active |= _inside_unexplained(view, active)
    # Those that hardly change are drawn in some views only.
    indices = [*cameras]
    some = {indices[k] for k in choose_key_views([*cameras.values()], config.quiet_views)}
    drawn = {v: active if v in some else active & (shares > QUIET) for v in cameras}
    blocks_by_view = {
        v: view.boxes.union(drawn[v], view.view.grid) | (view.counts > 0)
        for v, view in changed_views.items()
    }
    static = at_rest(gaussians.select(~active))
    views = {
        v: make_active_view(
            cameras[v], Region(changed_views[v].view.grid, blocks), static, channels[v], render
        )
        for v, blocks in blocks_by_view.items()
        if blocks.any()
    }
    return ActiveSet(np.flatnonzero(active), len(gaussians), views, len(cameras))


def _inside_unexplained(changed_view: ChangedView, active: np.ndarray) -> np.ndarray:
    """Return the Gaussians that lie by more than half in connected changes of which active ones
    cover less than half, bool [N].
    """
    grid = changed_view.view.grid
    boxes = changed_view.boxes
    counts = changed_view.counts
    changes = counts > _CHANGED * grid.block[0] * grid.block[1]
    covered = changes & boxes.union(active, grid)
    count, labels = cv2.connectedComponents(changes.astype(np.uint8))
    area, covered_area = (
        np.bincount(labels[blocks], counts[blocks], count) for blocks in (changes, covered)
    )
    missing = covered_area < EXPLAINED * area
    missing[0] = False
    labels = np.asarray(labels, np.int32)
    if not missing.any():
        return np.zeros_like(active)
    table = from_numpy(mi.UInt32, summed_area(missing[labels]))
    return np.asarray(boxes.within(table, grid) > 0.5 * boxes.area)

"""Responsibility and overlap of a Gaussian: how much of its visible surface changed, and in how
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

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.method.boxes import Boxes
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.region import Region, summed_area
from morgs_mi.render.view_group import ViewGroup


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
        if not changed_view.change.any():
            continue
        view = changed_view.view
        factor = max(view.camera.width // width, 1)
        h, w = (max(size // factor, 1) for size in changed_view.change.shape)
        change = changed_view.change.astype(np.float32)
        share = cv2.resize(change, (w, h), interpolation=cv2.INTER_AREA)
        region = Region.of(share > 0, view.config)
        near += boxes.within(region.block_table, region.grid, factor)
        views_with_changes.append(ActiveView(view.camera.resized(w, h), view.config, region))
        shares.append(share)
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
    return np.where(visible, change_weight / np.where(visible, weight * area_ratio, 1), 0)


def overlap(count: int, views: Iterable[ChangedView]) -> np.ndarray:
    """Return the overlap o [N] of `count` Gaussians with the changes, from 0 to 1; 0 for one that
    is in no view.
    """
    shares = np.zeros(count)
    counts = np.zeros_like(shares)
    for changed_view in views:
        area = np.asarray(changed_view.boxes.area)
        counts += area > 0
        if changed_view.change.any():
            table = from_numpy(mi.UInt32, summed_area(changed_view.counts > 0))
            shares += np.asarray(
                changed_view.boxes.within(table, changed_view.view.grid)
            ) / np.maximum(area, 1)
    return shares / np.maximum(counts, 1)

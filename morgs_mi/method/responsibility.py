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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

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
    reduced_views = list[_ReducedView]()
    for changed_view in views:
        boxes = changed_view.boxes
        area += boxes.area
        if changed_view.change.any():
            view = _reduced_view(changed_view, width)
            reduced_views.append(view)
            near += boxes.within(view.region.block_table, view.region.grid, view.factor)
    if not reduced_views:
        return np.zeros(len(gaussians), np.float32)
    change_weight, weight = _weights(gaussians, reduced_views)
    visible = weight > min_weight
    # At least 1: the box of a Gaussian beside the view may be empty, although it reaches into the
    # view.
    area_ratio = np.maximum(np.asarray(area / dr.maximum(near, 1)), 1)
    return np.where(visible, change_weight / np.where(visible, weight * area_ratio, 1), 0)


class _ReducedView(NamedTuple):
    """A view with changes at a fraction of its resolution."""

    view: ActiveView  # the blocks with changes
    region: Region  # these blocks
    share: np.ndarray  # changed share of each reduced pixel [h, w]
    factor: int  # by which the view is reduced


def _reduced_view(changed_view: ChangedView, width: int) -> _ReducedView:
    """Return a view reduced by the largest whole factor that leaves a width, in px."""
    view = changed_view.view
    factor = max(view.camera.width // width, 1)
    share = _reduced(changed_view.change, factor)
    region = Region(share > 0, view.config)
    camera = view.camera.resized(*share.shape[::-1])
    return _ReducedView(ActiveView(camera, view.config, region), region, share, factor)


def _weights(gaussians: Gaussians, views: Sequence[_ReducedView]) -> np.ndarray:
    """Return the blend weights [2, N] summed over changed pixels, and over all in their blocks, in
    px of the whole views.
    """
    group = ViewGroup([view.view for view in views])
    change = group.crop([view.share for view in views])
    blocks = [region.num_blocks for region in group.regions]
    # px of the view per reduced pixel.
    area = np.repeat(np.square([view.factor for view in views]), blocks)[:, None, None]
    maps = np.stack([area * change, np.broadcast_to(area, change.shape)], axis=-1)
    return group.draw(gaussians).totals(from_numpy(mi.Float, maps), 2).T


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


def _reduced(mask: np.ndarray, factor: int) -> np.ndarray:
    """Return the covered share of the pixels of a mask [H, W] at 1 / factor of its resolution,
    float32.
    """
    height, width = (max(size // factor, 1) for size in mask.shape)
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)

"""Responsibility: the share of a Gaussian's visible surface that has changed.

With the change mask c_v of view v and the blend weights w_iv(x) of frame t-1's Gaussians,

    r_i = sum_v sum_x w_iv c_v / sum_v sum_x w_iv .

A hidden Gaussian has no weight and is not responsible; one that something passes in front of in two of twenty views is
hardly so. Rendering all views to learn the denominator would cost more than the rest of a frame. So only the blocks R_v
of pixels with changes are rendered, and a Gaussian counts as equally visible elsewhere: with its boxes b_iv,

    r_i = (sum_v sum_{R_v} w_iv c_v / sum_v sum_{R_v} w_iv) (sum_v |b_iv and R_v| / sum_v |b_iv|) .

Large views are rendered at a fraction of their resolution, where c_v is the changed share of a pixel.
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
from morgs_mi.render.region import Region
from morgs_mi.render.view_group import ViewGroup

__all__ = ["ChangedView", "responsibility"]


@dataclass(frozen=True, eq=False)
class ChangedView:
    """A view, its changed pixels and the Gaussians in it.

    Attributes:
        view: the whole view.
        change: mask of the changed pixels, bool [H, W].
        boxes: boxes of the N Gaussians.
    """

    view: ActiveView
    change: np.ndarray
    boxes: Boxes

    @cached_property
    def counts(self) -> np.ndarray:
        """Number of changed pixels of each block, int32 [rows, columns]."""
        return self.view.grid.counts(self.change)


def responsibility(
    gaussians: Gaussians, views: Iterable[ChangedView], min_weight: float, width: int = 640
) -> np.ndarray:
    """Return the responsibility r [N] of each Gaussian for the changes, from 0 to 1; 0 for hidden ones.

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        views: V views with the boxes of these Gaussians.
        min_weight: blend weight summed over all changed blocks, in px, below which a Gaussian counts as hidden.
        width: views are reduced by the largest whole factor that leaves this width, in px.
    """
    near, area = dr.zeros(mi.Float, len(gaussians)), dr.zeros(mi.Float, len(gaussians))
    drawn, shares, factors = list[ActiveView](), list[np.ndarray](), list[int]()
    for changed_view in views:
        view, boxes = changed_view.view, changed_view.boxes
        area += boxes.area
        if not changed_view.change.any():
            continue
        factors.append(max(view.camera.width // width, 1))
        shares.append(_reduced(changed_view.change, factors[-1]))
        region = Region(shares[-1] > 0, view.config)
        drawn.append(ActiveView(view.camera.resized(*shares[-1].shape[::-1]), view.config, region))
        near += boxes.within(region.block_table, region.grid, factors[-1])
    if not drawn:
        return np.zeros(len(gaussians), np.float32)
    group = ViewGroup(drawn)
    change = group.crop(shares)
    blocks = [region.num_blocks for region in group.regions]
    area_of = np.repeat(np.square(factors), blocks)[:, None, None]  # px of the view per reduced pixel
    maps = from_numpy(mi.Float, np.stack([area_of * change, np.broadcast_to(area_of, change.shape)], axis=-1))
    changed, weight = group.draw(gaussians).totals(maps, 2).T
    seen = weight > min_weight
    # At least 1: the box of a Gaussian beside the view may be empty, although it reaches into the view.
    elsewhere = np.maximum(np.asarray(area / dr.maximum(near, 1)), 1)
    return np.where(seen, changed / np.where(seen, weight * elsewhere, 1), 0)


def _reduced(mask: np.ndarray, factor: int) -> np.ndarray:
    """Return the covered share of the pixels of a mask [H, W] at 1 / factor of its resolution, float32."""
    height, width = (max(size // factor, 1) for size in mask.shape)
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)

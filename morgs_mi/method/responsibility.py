"""Responsibility: the share of a Gaussian's visible surface that has changed.

With the change mask c_v of view v and the blend weights w_iv(x) of frame t-1's Gaussians,

    r_i = sum_v sum_x w_iv c_v / sum_v sum_x w_iv .

A hidden Gaussian has no weight and is not responsible; one that something passes in front of in two of twenty views is
hardly so. Rendering all views to learn the denominator would cost more than the rest of a frame. So only the blocks R_v
of pixels with changes are rendered, and a Gaussian counts as equally visible elsewhere: with its boxes b_iv,

    r_i = (sum_v sum_{R_v} w_iv c_v / sum_v sum_{R_v} w_iv) (sum_v |b_iv and R_v| / sum_v |b_iv|) .
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.boxes import Boxes
from morgs_mi.render.backproject import backproject
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.region import Region

__all__ = ["Responsibility", "responsibility"]


@dataclass(frozen=True, eq=False)
class Responsibility:
    """Responsibility of N Gaussians for the changes of all views.

    Attributes:
        changed: blend weight in changed pixels [N], summed over all views.
        visible: blend weight in all pixels [N], likewise; 0 for a Gaussian that counts as hidden.
    """

    changed: np.ndarray
    visible: np.ndarray

    @property
    def share(self) -> np.ndarray:
        """Ratio of both [N], from 0 to 1; 0 for hidden Gaussians."""
        return _ratio(self.changed, self.visible)


def _ratio(changed: np.ndarray, visible: np.ndarray) -> np.ndarray:
    return np.where(visible > 0, changed / np.maximum(visible, 1e-30), 0)


def responsibility(
    gaussians: Gaussians,
    cameras: Mapping[int, Camera],
    changes: Mapping[int, np.ndarray],
    boxes: Mapping[int, Boxes],
    render: RenderConfig,
    min_weight: float = 1.0,
) -> Responsibility:
    """Return the responsibility of each Gaussian for the changes.

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        cameras: V cameras, by view index.
        changes: masks of their changed pixels, bool [H, W], by view index.
        boxes: boxes of the Gaussians in these views, by view index.
        render: cut-offs.
        min_weight: blend weight summed over all changed blocks, in px, below which a Gaussian counts as hidden.
    """
    changed, weight = np.zeros(len(gaussians), np.float32), np.zeros(len(gaussians), np.float32)
    near, area = dr.zeros(mi.Float, len(gaussians)), dr.zeros(mi.Float, len(gaussians))
    for view, camera in cameras.items():
        area += boxes[view].area
        if not changes[view].any():
            continue
        region, c = Region(changes[view], render), changes[view]
        image = region.crop(np.stack([c, np.ones_like(c)], axis=-1).astype(np.float32))
        sums = backproject(gaussians, camera, image, render, region)
        changed, weight = changed + sums[:, 0], weight + sums[:, 1]
        near += boxes[view].covered(region.paste(np.ones(region.shape(1)[:3], bool), np.zeros_like(c)))
    seen = weight > min_weight
    elsewhere = np.asarray(area / dr.maximum(near, 1))
    return Responsibility(np.where(seen, changed, 0), np.where(seen, weight * elsewhere, 0))

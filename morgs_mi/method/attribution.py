"""Attribution of the rendering error to Gaussians, by their blend weights.

With the error e(x) of a rendered view, E_i = sum_x w_i(x) e(x) is the error attributed to Gaussian i there (Bulo et al.
2024), and W_i = sum_x w_i(x) the number of pixels that it covers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.ssim import Target
from morgs_mi.method.sweep import KeyImages
from morgs_mi.render.active_view import ActiveView

__all__ = ["DensificationScores", "densification_scores"]

# Share of the pixels of a view up to which views are drawn together: more of them would take more memory than time.
_TOGETHER = 2.0


@dataclass(frozen=True)
class DensificationScores:
    """Densification scores of N Gaussians.

    Attributes:
        error: attributed error E [N], in pixels of full contrast, of the view where it is largest.
        weight: covered pixels W [N], of the view where they are most; 0 for a Gaussian that no view sees.
    """

    error: np.ndarray
    weight: np.ndarray


def densification_scores(
    gaussians: Gaussians, views: Sequence[ActiveView], targets: Sequence[Target], tolerance: float = 0.0
) -> DensificationScores:
    """Render every view and return the densification scores of the Gaussians.

    Args:
        gaussians: N Gaussians.
        views: V active views.
        targets: their images.
        tolerance: in medians of an image's error; smaller errors do not count.
    """
    gaussians = gaussians.detached()
    error, weight = np.zeros((2, len(gaussians)), np.float32)
    for few in _few_at_once(views):
        images = KeyImages({v: views[v] for v in few}, dict(enumerate(targets)))
        sums = images.sums(gaussians, ("error", "weight"), tolerance)
        error, weight = np.maximum(error, sums["error"].max(0)), np.maximum(weight, sums["weight"].max(0))
    return DensificationScores(error, weight)


def _few_at_once(views: Sequence[ActiveView]) -> Iterator[list[int]]:
    """Yield the indices of views that are drawn together, at least one."""
    few, share = list[int](), 0.0
    for index, view in enumerate(views):
        if few and share + view.pixel_fraction > _TOGETHER:
            yield few
            few, share = [], 0.0
        few.append(index)
        share += view.pixel_fraction
    if few:
        yield few

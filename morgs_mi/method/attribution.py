"""Attribution of the rendering error to Gaussians, by their blend weights.

With the error e(x) of a rendered view, E_i = sum_x w_i(x) e(x) is the error attributed to Gaussian i there (Bulo et al.
2024), and W_i = sum_x w_i(x) the number of pixels that it covers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView

__all__ = ["DensificationScores", "attribute_error", "densification_scores"]


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
    attributed = [attribute_error(gaussians, *pair, tolerance) for pair in zip(views, targets, strict=True)]
    error, weight = np.max([np.zeros((len(gaussians), 2), np.float32), *attributed], axis=0).T
    return DensificationScores(error, weight)


def attribute_error(gaussians: Gaussians, view: ActiveView, target: Target, tolerance: float = 0.0) -> np.ndarray:
    """Render one view and return E and W of each Gaussian there, [N, 2], in pixels of full contrast and in pixels.

    Args:
        gaussians: N Gaussians, detached.
        view: the active view.
        target: its image.
        tolerance: in medians of the image's error; smaller errors do not count.
    """
    error = np.abs(target.difference(view.render(gaussians).color, view.region)).mean(axis=-1)
    positive = error[error > 0]  # masked pixels are 0
    if tolerance and len(positive):
        error = np.maximum(error - tolerance * np.median(positive), 0)
    return view.backproject(gaussians, np.stack([error, np.ones_like(error)], axis=-1))

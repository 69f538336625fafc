"""Which Gaussians a rendering error is attributed to, by their blend weights.

E_i = sum_x w_i(x) e(x) is the error attributed to Gaussian i in a view (Bulo et al. 2024), with its blend weights w_i,
and W_i = sum_x w_i(x) the number of pixels that it covers there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.losses.ssim import Target
from morgs_mi.render.active_view import ActiveView

__all__ = ["NOISE_TOLERANCE", "DensificationScores", "attribute_error", "densification_scores"]

# Normal noise, independent in three colours, exceeds so many times its median error at 3 of 10,000 pixels.
NOISE_TOLERANCE = 3.0


@dataclass(frozen=True)
class DensificationScores:
    """What the pictures say of N Gaussians.

    Attributes:
        error: E [N], of the view where it is largest.
        weight: W [N], pixels, of the view where it is largest; 0 for who is seen nowhere.
    """

    error: np.ndarray
    weight: np.ndarray


def densification_scores(
    gaussians: Gaussians, windows: Sequence[ActiveView], targets: Sequence[Target], tolerance: float = 0.0
) -> DensificationScores:
    """Render every view, and give each Gaussian its share of the errors and of the pixels (E and W).

    Args:
        gaussians: N of them.
        windows: onto V views.
        targets: their pictures.
        tolerance: in medians of a picture's error; what does not exceed it does not count.
    """
    gaussians = gaussians.detached()
    shares = [attribute_error(gaussians, *view, tolerance) for view in zip(windows, targets, strict=True)]
    error, weight = np.max([np.zeros((len(gaussians), 2), np.float32), *shares], axis=0).T
    return DensificationScores(error, weight)


def attribute_error(gaussians: Gaussians, window: ActiveView, target: Target, tolerance: float = 0.0) -> np.ndarray:
    """Render a view, and return each Gaussian's E and W there (see above), [N, 2], in px of full contrast and in px.

    Args:
        gaussians: N of them, detached.
        window: onto the view.
        target: its picture.
        tolerance: in medians of the picture's error; what does not exceed it does not count.
    """
    wrong = np.abs(target.difference(window.render(gaussians).color, window.region)).mean(axis=-1)
    seen = wrong[wrong > 0]  # where masked, it is 0
    wrong = np.maximum(wrong - tolerance * np.median(seen), 0) if tolerance and len(seen) else wrong
    return window.backproject(gaussians, np.stack([wrong, np.ones_like(wrong)], axis=-1))

"""The terms of eq. 13: L_recon (eq. 2), L_flow (eq. 7), L_mask (eq. 11) and L_off, each a scalar Dr.Jit tensor.

Every loss is a mean, over pixels or Gaussians, so that its weight does not depend on the size of the image.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from morgs_mi.losses.ssim import OnRegion, Target, WholeView
from morgs_mi.render.region import Region

__all__ = ["flow_loss", "mask_loss", "offset_loss", "recon_loss"]


def recon_loss(image: Any, target: Target, dssim_weight: float = 0.2, region: Region | None = None) -> Any:
    """Return (1 - lambda) mean |I - I*| + lambda (1 - SSIM) (eq. 2), differentiable in `image`.

    Value and derivative are computed together, so that backward costs one multiplication.

    Args:
        image: [H, W, 3], or a picture on the region.
        target: what it should show.
        dssim_weight: lambda.
        region: only its pixels have changed since `Target.set_surroundings` was called; a target without surroundings
            takes itself as what surrounds the region. The derivative is then the whole view's; the value leaves out
            what cannot have changed: pixels outside, windows that see none inside.

    Raises:
        ValueError: image and target differ in size.
    """
    expected = tuple(target.shape if region is None else region.shape(3))
    if tuple(image.shape) != expected:
        raise ValueError(f"recon_loss(): `image` must be {expected} like its target, got {tuple(image.shape)}.")
    if region is None or region.whole:
        return dr.custom(WholeView, image.array, target, dssim_weight)
    if (region.height, region.width) != target.shape[:2]:
        raise ValueError(
            f"recon_loss(): `region` must be of a {target.shape[1]}x{target.shape[0]} view like its target, got "
            f"{region.width}x{region.height}."
        )
    return dr.custom(OnRegion, image.array, target, dssim_weight, region)


def flow_loss(motion: Any, cue: Any, reliable: Any, num_pixels: int | None = None) -> Any:
    """Return the mean endpoint error in px between the rendered motion map and the flow's motion (eq. 7).

    Args:
        motion: rendered [H, W, 2], px, x_t - x_{t-1}; or on a region.
        cue: from optical flow on the same grid and of the same shape, px, of the same sign.
        reliable: [H, W] of 0 and 1, or on the region; the mean is over all pixels, so that little evidence weighs
            little.
        num_pixels: of the view; None: those given.
    """
    n = dr.width(motion) // 2
    lane = dr.arange(mi.UInt32, n) * 2
    x, y = (
        dr.gather(mi.Float, motion.array, lane + k, mode=dr.ReduceMode.NoConflicts)
        - dr.gather(mi.Float, cue.array, lane + k)
        for k in range(2)
    )
    # A hundredth of a pixel keeps the derivative finite where both agree.
    return _mean(dr.sqrt(x * x + y * y + 1e-4) * reliable.array, num_pixels)


def mask_loss(confidence: Any, mask: Any, num_pixels: int | None = None) -> Any:
    """Return mean |M~ - M| of the rendered confidence [H, W, 1] and the motion mask [H, W] (eq. 11), as `flow_loss`."""
    return _mean(dr.abs(confidence.array - mask.array), num_pixels)


def offset_loss(offset: Any, extent: float, num_gaussians: int | None = None) -> Any:
    """Return the mean L1 norm of the offsets [N, 3] over the scene's extent (L_off); N may be more than are given."""
    return dr.sum(dr.abs(offset.array)) * dr.opaque(mi.Float, 1 / ((num_gaussians or int(offset.shape[0])) * extent))


def _mean(values: Any, count: int | None) -> Any:
    return dr.sum(values) * dr.opaque(mi.Float, 1 / (count or dr.width(values)))

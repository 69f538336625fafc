"""The terms of eq. 13: L_recon (eq. 2), L_flow (eq. 7), L_mask (eq. 11) and L_off, each a scalar
Dr.Jit tensor.

Every loss is a mean over pixels or Gaussians. Its weight does not depend on the size of the image.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Tensor
from morgs_mi.method.ssim import Recon, Target
from morgs_mi.render.backend import elements
from morgs_mi.render.region import Region


def recon_loss(
    image: Tensor, target: Target, dssim_weight: float, region: Region | None = None
) -> Tensor:
    """Return (1 - lambda) mean |I - I*| + lambda (1 - SSIM) (eq. 2), differentiable in `image`.

    Value and derivative are computed together, and the backward pass costs one multiplication.

    Args:
        image: rendered image [H, W, 3], or an image on the region.
        target: image to match.
        dssim_weight: lambda.
        region: the only pixels that are compared; the target itself surrounds them. The derivative
            equals the whole view's. The value omits pixels outside the region and SSIM windows
            without pixels inside, because they cannot have changed.
    """
    part = None if region is None or region.whole else region
    return dr.custom(Recon, image.array, target, dssim_weight, part)


def flow_loss(motion: Tensor, target: Tensor, reliable: Tensor, num_pixels: int) -> Tensor:
    """Return the mean endpoint error in px between the rendered motion map and the observed motion
    (eq. 7).

    Args:
        motion: rendered motion map [H, W, 2], px, x_t - x_{t-1}; or on a region.
        target: motion by optical flow on the same grid, of the same shape and sign, px.
        reliable: [H, W] of 0 and 1, or on the region. The mean is over all pixels: few reliable
            pixels weigh little.
        num_pixels: of the whole view.
    """
    lane = dr.arange(mi.UInt32, dr.width(motion) // 2) * 2
    x, y = (
        dr.gather(mi.Float, motion.array, lane + k, mode=dr.ReduceMode.NoConflicts)
        - elements(target.array, lane + k)
        for k in range(2)
    )
    # A hundredth of a pixel keeps the derivative finite where both agree.
    total = dr.sum(dr.sqrt(x * x + y * y + 1e-4) * reliable.array)
    return total * dr.opaque(mi.Float, 1 / num_pixels)


def mask_loss(confidence: Tensor, mask: Tensor, num_pixels: int) -> Tensor:
    """Return mean |M~ - M| of the rendered confidence [H, W, 1] and the motion mask [H, W]
    (eq. 11), as `flow_loss`.
    """
    total = dr.sum(dr.abs(confidence.array - mask.array))
    return total * dr.opaque(mi.Float, 1 / num_pixels)


def offset_loss(offset: Tensor, extent: float, num_gaussians: int) -> Tensor:
    """Return the mean L1 norm of the offsets [N, 3] in scene extents (L_off).

    Args:
        offset: offsets of the active Gaussians, world units.
        extent: of the scene, world units.
        num_gaussians: of the whole scene.
    """
    return dr.sum(dr.abs(offset.array)) * dr.opaque(mi.Float, 1 / (num_gaussians * extent))

"""The terms of eq. 13: L_recon (eq. 2), L_flow (eq. 7), L_mask (eq. 11) and L_off, each a scalar
Dr.Jit tensor.

Every loss is a mean over pixels or Gaussians. Its weight does not depend on the size of the image.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from morgs_mi.core.checks import check_number, check_type
from morgs_mi.core.types import Float, Tensor
from morgs_mi.method.ssim import OnRegion, Target, WholeView
from morgs_mi.render.region import Region


def recon_loss(
    image: Tensor, target: Target, dssim_weight: float = 0.2, region: Region | None = None
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

    Raises:
        ValueError: image and target differ in size.
    """
    check_type("recon_loss()", "target", target, Target)
    check_number("recon_loss()", "dssim_weight", dssim_weight, "[0, 1]")
    _check_shape(
        "recon_loss()", "image", image, target.shape if region is None else region.shape(3)
    )
    if region is None or region.whole:
        return dr.custom(WholeView, image.array, target, dssim_weight)
    if (region.height, region.width) != target.shape[:2]:
        raise ValueError(
            f"recon_loss(): `region` must be of a {target.shape[1]}x{target.shape[0]} view like "
            f"its target, got {region.width}x{region.height}."
        )
    return dr.custom(OnRegion, image.array, target, dssim_weight, region)


def flow_loss(
    motion: Tensor, target: Tensor, reliable: Tensor, num_pixels: int | None = None
) -> Tensor:
    """Return the mean endpoint error in px between the rendered motion map and the observed motion
    (eq. 7).

    Args:
        motion: rendered motion map [H, W, 2], px, x_t - x_{t-1}; or on a region.
        target: motion by optical flow on the same grid, of the same shape and sign, px.
        reliable: [H, W] of 0 and 1, or on the region. The mean is over all pixels: few reliable
            pixels weigh little.
        num_pixels: of the whole view; None: those given.
    """
    pixels = _shape_of(motion)[:-1]
    _check_shape("flow_loss()", "motion", motion, (*pixels, 2))
    _check_shape("flow_loss()", "target", target, (*pixels, 2))
    _check_shape("flow_loss()", "reliable", reliable, pixels)
    lane = dr.arange(mi.UInt32, dr.width(motion) // 2) * 2
    x, y = (
        dr.gather(mi.Float, motion.array, lane + k, mode=dr.ReduceMode.NoConflicts)
        - dr.gather(mi.Float, target.array, lane + k)
        for k in range(2)
    )
    # A hundredth of a pixel keeps the derivative finite where both agree.
    return _mean(dr.sqrt(x * x + y * y + 1e-4) * reliable.array, num_pixels)


def mask_loss(confidence: Tensor, mask: Tensor, num_pixels: int | None = None) -> Tensor:
    """Return mean |M~ - M| of the rendered confidence [H, W, 1] and the motion mask [H, W]
    (eq. 11), as `flow_loss`.
    """
    pixels = _shape_of(confidence)[:-1]
    _check_shape("mask_loss()", "confidence", confidence, (*pixels, 1))
    _check_shape("mask_loss()", "mask", mask, pixels)
    return _mean(dr.abs(confidence.array - mask.array), num_pixels)


def offset_loss(offset: Tensor, extent: float, num_gaussians: int | None = None) -> Tensor:
    """Return the mean L1 norm of the offsets [N, 3] in scene extents (L_off).

    Args:
        offset: offsets of the active Gaussians, world units.
        extent: of the scene, world units.
        num_gaussians: of the whole scene; None: those given.
    """
    check_number("offset_loss()", "extent", extent, "(0, inf)")
    _check_shape("offset_loss()", "offset", offset, (*_shape_of(offset)[:1], 3))
    return dr.sum(dr.abs(offset.array)) * dr.opaque(
        mi.Float, 1 / ((num_gaussians or int(offset.shape[0])) * extent)
    )


def _shape_of(tensor: Tensor) -> tuple[int, ...]:
    """Return the shape of a tensor, or () for any other value, which `_check_shape` refuses."""
    return tuple(getattr(tensor, "shape", ()))


def _check_shape(place: str, name: str, tensor: Tensor, shape: Sequence[int]) -> None:
    """Raise an error unless a tensor has a shape and no size is 0."""
    check_type(place, name, tensor, mi.TensorXf)
    if tuple(tensor.shape) != tuple(shape) or 0 in shape:
        raise ValueError(
            f"{place}: `{name}` must be {list(shape)} with sizes above 0, got "
            f"{list(tensor.shape)}; render and observe the same pixels."
        )


def _mean(values: Float, count: int | None) -> Tensor:
    return dr.sum(values) * dr.opaque(mi.Float, 1 / (count or dr.width(values)))

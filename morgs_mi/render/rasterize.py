"""The one public call of the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.gaussians.gaussians import ActivatedGaussians, repeated
from morgs_mi.render.blocks import build_lists
from morgs_mi.render.compositing import Layout, blend
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import CHANNEL_SIZES, project

__all__ = ["Image", "rasterize"]

_CHANNELS = ("color", "alpha", "depth", "motion", "confidence")
_NORMALISED = ("depth", "motion")  # divided by alpha: expected values, not sums


@dataclass(frozen=True)
class Image:
    """Tensors of one view, those that were asked for; H rows, W columns.

    Attributes:
        color: display-referred colour [H, W, 3].
        alpha: 1 - transmittance [H, W, 1].
        depth: expected camera-space z [H, W, 1], world units; 0 where nothing is.
        motion: where each pixel came from [H, W, 2], px, x_t - x_{t-1} (eq. 6); 0 where nothing is.
        confidence: blended motion confidence [H, W, 1].
    """

    color: Any = None
    alpha: Any = None
    depth: Any = None
    motion: Any = None
    confidence: Any = None


def rasterize(
    gaussians: ActivatedGaussians,
    camera: Camera,
    channels: Sequence[str] = ("color", "alpha"),
    background: Sequence[float] | None = None,
    detach_weights: Sequence[str] = (),
    config: RenderConfig | None = None,
) -> Image:
    """Render Gaussians by depth-ordered alpha blending (eq. 1), differentiably.

    `dr.backward` and `dr.forward` give the derivatives with respect to every attribute of `gaussians`, and
    to the pose where `camera.viewmat` is a Dr.Jit tensor. What is not asked for is neither traced nor run.

    Args:
        gaussians: N Gaussians, usually a `Gaussians`; anything with its activated attributes will do.
        camera: the view.
        channels: out of ``color``, ``alpha``, ``depth``, ``motion``, ``confidence``. Colour and confidence are
            sums weighted by T alpha; depth and motion are divided by the sum of those weights.
        background: display-referred colour [3] behind everything; None is black.
        detach_weights: channels whose gradient reaches only what is blended, not opacity and geometry.
        config: cut-offs and block shape.

    Returns:
        An `Image` with one tensor per requested channel.

    Raises:
        ValueError: an unknown channel, a channel whose attribute is missing, NaN or infinite attributes.

    Equal depths are blended in the order of the input. A quaternion of length 0 does not rotate. What lies before
    the camera's near plane or beyond 1e18 units, and what overflows float32 once projected, is not drawn.
    It does not antialias beyond `eps2d`, and it does not undistort lenses.
    """
    config = config or RenderConfig()
    channels = tuple(dict.fromkeys(channels))
    _check(gaussians, camera, channels, background, detach_weights)
    W, H = camera.width, camera.height
    blended = tuple(c for c in channels if c != "alpha")
    if dr.prod(gaussians.means.shape[:1]) == 0:
        return _empty(channels, background, W, H)

    splats = project(gaussians, camera, blended, config)
    dr.schedule(splats.shape, splats.channels, splats.depths, splats.extent, splats.slopes, splats.valid)
    _check_finite(splats.finite, gaussians)
    with dr.suspend_grad():
        lists = build_lists(splats, W, H, config)

    attached = tuple(name not in detach_weights for name in blended for _ in range(CHANNEL_SIZES[name]))
    alpha_attached = (
        ("alpha" in channels and "alpha" not in detach_weights)
        or ("color" in channels and background is not None and "color" not in detach_weights)
        or any(name in blended and name not in detach_weights for name in _NORMALISED)
    )
    values = [splats.channels[name] for name in blended]
    *parts, alpha, coverage = blend(splats.shape, values, lists, Layout(attached, alpha_attached, config), W * H)
    images = {"alpha": alpha}
    for name, value in zip(blended, parts, strict=True):
        weight = dr.detach(coverage) if name in detach_weights else coverage
        if name in _NORMALISED:
            weight = repeated(weight, CHANNEL_SIZES[name])
            value = dr.select(weight > 0, value / dr.maximum(weight, 1e-8), 0)
        elif name == "color" and background is not None:
            backdrop = dr.gather(mi.Float, mi.Float(np.float32(background)), dr.arange(mi.UInt32, W * H * 3) % 3)
            value = dr.fma(1 - repeated(weight, 3), backdrop, value)
        images[name] = value
    return Image(**{n: mi.TensorXf(images[n], (H, W, CHANNEL_SIZES.get(n, 1))) for n in channels})


def _empty(channels: tuple[str, ...], background: Sequence[float] | None, W: int, H: int) -> Image:
    """Return the image of no Gaussians."""
    images = {n: dr.zeros(mi.TensorXf, (H, W, CHANNEL_SIZES.get(n, 1))) for n in channels}
    if background is not None and "color" in images:
        images["color"] = mi.TensorXf(np.tile(np.float32(background), (H, W, 1)))
    return Image(**images)


def _check(
    gaussians: ActivatedGaussians,
    camera: Camera,
    channels: tuple[str, ...],
    background: Sequence[float] | None,
    detach_weights: Sequence[str],
) -> None:
    if mi.variant() is None or not dr.is_jit_v(mi.Float) or not dr.is_diff_v(mi.Float):
        raise ValueError(
            f"rasterize(): expected a Mitsuba variant such as 'llvm_ad_rgb' or 'cuda_ad_rgb', "
            f"got {mi.variant()!r}; call mi.set_variant() first."
        )
    for name in (*channels, *detach_weights):
        if name not in _CHANNELS:
            raise ValueError(f"rasterize(): `channels` must be out of {', '.join(_CHANNELS)}, got {name!r}.")
    for name in ("motion", "confidence"):
        if name in channels and getattr(gaussians, name) is None:
            raise ValueError(
                f"rasterize(): channel {name!r} needs Gaussians that carry it, got none; "
                f"set `{'motion' if name == 'motion' else 'logit_confidence'}` or leave the channel out."
            )
    if background is not None and not (np.shape(background) == (3,) and np.isfinite(background).all()):
        raise ValueError(f"rasterize(): `background` must be three finite numbers, got {background!r}.")
    if camera.width * camera.height > 2**28:
        raise ValueError(
            f"rasterize(): the image must have at most 2^28 pixels, got {camera.width}x{camera.height}; "
            "render it in parts."
        )


def _check_finite(finite: Any, gaussians: ActivatedGaussians) -> None:
    """Raise if a projected Gaussian is not finite because its attributes are not."""
    if dr.all(finite):
        return
    for name in ("means", "scales", "quats", "opacities", "sh_coeffs", "motion", "confidence"):
        value = getattr(gaussians, name)
        if value is None:
            continue
        bad = np.argwhere(~np.isfinite(np.asarray(dr.detach(value))))
        if len(bad):
            index = ", ".join(map(str, bad[0]))
            raise ValueError(
                f"rasterize(): `{name}` must be finite, got {np.asarray(dr.detach(value))[tuple(bad[0])]} at "
                f"[{index}] ({len(bad)} such values); clean the Gaussians or lower the learning rate."
            )

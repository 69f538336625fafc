"""The one public call of the renderer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians, repeat_each
from morgs_mi.render.blocks import build_lists, touches
from morgs_mi.render.compositing import Channel, Layout, blend
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import CHANNEL_SIZES, Splats, concatenated, project
from morgs_mi.render.region import Region, full_view, owned_copy

__all__ = ["Image", "rasterize"]

_CHANNELS = ("color", "alpha", "depth", "motion", "confidence")
# More would not fit a record of six packets beside all other channels.
_MOST_FEATURES = 12
_NORMALISED = ("depth", "motion")  # divided by alpha: expected values, not sums


@dataclass(frozen=True)
class Image:
    """Tensors of one view, those that were asked for; H rows, W columns.

    On a region all of them are [A, block_height, block_width, C] in place of [H, W, C], and 0 outside the view.

    Attributes:
        color: display-referred colour [H, W, 3].
        alpha: 1 - transmittance [H, W, 1].
        depth: expected camera-space z [H, W, 1], world units; 0 where nothing is.
        motion: where each pixel came from [H, W, 2], px, x_t - x_{t-1} (eq. 6); 0 where nothing is.
        confidence: blended motion confidence [H, W, 1].
        features: blended features [H, W, F].
    """

    color: Any = None
    alpha: Any = None
    depth: Any = None
    motion: Any = None
    confidence: Any = None
    features: Any = None


def rasterize(
    gaussians: ActivatedGaussians,
    camera: Camera,
    channels: Sequence[str] = ("color", "alpha"),
    background: Sequence[float] | None = None,
    detach_weights: Sequence[str] = (),
    region: Region | None = None,
    active: Any | None = None,
    features: Any | None = None,
    static_splats: Splats | None = None,
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
        region: the blocks of pixels to draw; None: the whole view. What it does not need is not done: Gaussians that
            touch none of its blocks are only projected.
        active: bool [N], the Gaussians that gradients reach; None: all.
        features: [N, F], whatever else is to be blended like colours, in `Image.features`; F is at most 12.
        static_splats: splats of this view that are drawn as well and get no gradients; they must have the channels.
        config: cut-offs and block shape.

    Returns:
        An `Image` with one tensor per requested channel. On a region, and with `active`, what is drawn and the
        gradients that are left are those of the full computation.

    Raises:
        ValueError: an unknown channel, a channel whose attribute is missing, NaN or infinite attributes, a region of
            another view or block shape.

    Equal depths are blended in the order of the input. A quaternion of length 0 does not rotate. What lies before
    the camera's near plane or beyond 1e18 units, and what overflows float32 once projected, is not drawn.
    It does not antialias beyond `eps2d`, and it does not undistort lenses.
    """
    config = config or RenderConfig()
    channels, sizes = tuple(dict.fromkeys(channels)), {**CHANNEL_SIZES, "alpha": 1}
    _check(gaussians, camera, channels, background, detach_weights)
    if features is not None:
        features, sizes["features"] = _checked_features(features, gaussians)
        channels = (*channels, "features")
    region = region or full_view(camera.width, camera.height, config)
    _check_region(region, camera, config)
    blended = tuple(c for c in channels if c != "alpha")
    if dr.prod(gaussians.means.shape[:1]) == 0:
        return _empty(channels, sizes, background, region)
    if static_splats is not None:
        splats = project(gaussians, camera, blended, config, features=features).concatenated_with(static_splats, None)
    elif region.whole and active is None:
        splats = project(gaussians, camera, blended, config, features=features)
    else:
        splats = _project_part(gaussians, camera, blended, region, active, features, config)
    if splats is None:
        return _empty(channels, sizes, background, region)
    dr.schedule(splats.shape, splats.channels, splats.depths, splats.extent, splats.valid)
    _check_finite(splats.finite, gaussians, features)
    values = [splats.channels[name] for name in blended]
    with dr.suspend_grad():
        lists = build_lists(splats, [column for columns in values for column in columns], region, config)
    layout = _layout(channels, sizes, background, detach_weights, config)
    parts = blend(splats.shape, values, region, lists, layout)
    images = dict(zip((*blended, "alpha", "coverage"), parts, strict=False))
    coverage = images.pop("coverage", None)
    for name in blended:
        if name in _NORMALISED or (name == "color" and background is not None):
            weight = repeat_each(dr.detach(coverage) if name in detach_weights else coverage, CHANNEL_SIZES[name])
            finish = _normalised if name in _NORMALISED else _over(background)
            images[name] = finish(images[name], weight)
    return Image(**{name: _tensor(images[name], region, sizes[name]) for name in channels})


def _normalised(values: Any, weight: Any) -> Any:
    """Divide by the sum of the weights; 0 where nothing is."""
    return dr.select(weight > 0, values / dr.maximum(weight, 1e-8), 0)


def _over(background: Sequence[float] | None) -> Callable[[Any, Any], Any]:
    """Return what fills a colour up with the background."""
    behind = mi.Float(np.float32(background))
    return lambda values, weight: dr.fma(
        1 - weight, dr.gather(mi.Float, behind, dr.arange(mi.UInt32, dr.width(weight)) % 3), values
    )


def _project_part(
    gaussians: ActivatedGaussians,
    camera: Camera,
    channels: tuple[str, ...],
    region: Region,
    active: Any | None,
    features: Any | None,
    config: RenderConfig,
) -> Splats | None:
    """Project those Gaussians that the region may show, attached to the gradient graph only those that are active."""
    still, still_features = dr.detach(gaussians), None if features is None else dr.detach(features)
    with dr.suspend_grad():
        everything = project(still, camera, (), config)
        shown = touches(everything, region)
        dr.schedule(shown)
        _check_finite(everything.finite, gaussians, features)
        if active is None:
            rows = [dr.compress(shown)]
        else:
            active = mi.Bool(active)
            N = int(gaussians.means.shape[0])
            if dr.width(active) != N:
                raise ValueError(f"rasterize(): `active` must be bool [N] with N={N}, got {dr.width(active)} values.")
            rows = [dr.compress(shown & active), dr.compress(shown & ~active)]
    parts = [
        project(some, camera, channels, config, index, blended)
        for some, blended, index in zip((gaussians, still), (features, still_features), rows, strict=False)
        if dr.width(index)
    ]
    if len(parts) < 2:
        return parts[0] if parts else None
    return parts[0].concatenated_with(parts[1], dr.argsort(concatenated(*rows)))


def _layout(
    channels: tuple[str, ...],
    sizes: Mapping[str, int],
    background: Sequence[float] | None,
    detach_weights: Sequence[str],
    config: RenderConfig,
) -> Layout:
    """Return what is blended, and what its gradients reach."""
    # Who reads alpha: those who ask for it, and those who divide by it or fill up with it.
    readers = [
        name
        for name in channels
        if name == "alpha" or name in _NORMALISED or (name == "color" and background is not None)
    ]
    parts = tuple(Channel(sizes[name], name not in detach_weights) for name in channels if name != "alpha")
    return Layout(parts, bool(readers), any(name not in detach_weights for name in readers), config)


def _tensor(values: Any, region: Region, size: int) -> Any:
    """Return a channel's picture; pixels of a region that lie outside the view are 0."""
    if region.weights is not None:
        values = values * repeat_each(region.weights, size)
    return mi.TensorXf(values, region.shape(size))


def _empty(
    channels: tuple[str, ...], sizes: Mapping[str, int], background: Sequence[float] | None, region: Region
) -> Image:
    """Return the image of no Gaussians."""
    images = {n: dr.zeros(mi.TensorXf, region.shape(sizes[n])) for n in channels}
    if background is not None and "color" in images:
        static_splats = np.broadcast_to(np.float32(background), region.shape(3))
        images["color"] = _tensor(mi.Float(static_splats.ravel()), region, 3)
    return Image(**images)


def _check_region(region: Region, camera: Camera, config: RenderConfig) -> None:
    block = config.block_shape(dr.backend_v(mi.Float) == dr.JitBackend.CUDA)
    found = (region.width, region.height, *region.block)
    if found != (camera.width, camera.height, *block):
        raise ValueError(
            f"rasterize(): `region` must be of a {camera.width}x{camera.height} view with {block[0]}x{block[1]} blocks "
            f"like the camera's and the config's, got {found[0]}x{found[1]} with {found[2]}x{found[3]}."
        )


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
        if name not in _CHANNELS and not (name == "features" and name not in channels):
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


def _checked_features(features: Any, gaussians: ActivatedGaussians) -> tuple[Any, int]:
    """Return the features as a tensor [N, F], and F."""
    features = (
        features
        if dr.is_tensor_v(features)
        else mi.TensorXf(owned_copy(mi.Float(np.ravel(features))), np.shape(features))
    )
    shape, N = tuple(features.shape), int(gaussians.means.shape[0])
    if len(shape) != 2 or shape[0] != N or not 1 <= shape[1] <= _MOST_FEATURES:
        raise ValueError(
            f"rasterize(): `features` must be [N, F] with N={N} and F from 1 to {_MOST_FEATURES}, got {list(shape)}; "
            "blend more in several calls."
        )
    return features, shape[1]


def _check_finite(finite: Any, gaussians: ActivatedGaussians, features: Any | None) -> None:
    """Raise if a projected Gaussian is not finite because its attributes are not."""
    if dr.all(finite):
        return
    names = ("means", "scales", "quats", "opacities", "sh_coeffs", "motion", "confidence")
    for name, value in {**{name: getattr(gaussians, name) for name in names}, "features": features}.items():
        if value is None:
            continue
        bad = np.argwhere(~np.isfinite(np.asarray(dr.detach(value))))
        if len(bad):
            index = ", ".join(map(str, bad[0]))
            raise ValueError(
                f"rasterize(): `{name}` must be finite, got {np.asarray(dr.detach(value))[tuple(bad[0])]} at "
                f"[{index}] ({len(bad)} such values); clean the Gaussians or lower the learning rate."
            )

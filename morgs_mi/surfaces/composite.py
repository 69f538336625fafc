"""Splats and surfaces in one image.

Per pixel, a fraction f is covered by surfaces at depth z, with radiance L there and E elsewhere.
C(z) and T(z) are the blended colour of the splats in front of z and the transmittance that remains;
at z = inf, of all splats:

    f dec(C(z) + T(z) enc(L)) + (1 - f) dec(C(inf) + T(inf) enc(E))

`enc` encodes linear light like the colours of the splats (sRGB, or not at all) and `dec` decodes
it: a surface is blended like one more splat, and the two parts of a pixel are averaged in linear
light, as a film does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.color_space import decode_traced, encode_traced
from morgs_mi.core.gaussians import ActivatedGaussians, read_columns
from morgs_mi.core.types import Float, Jit, Tensor
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.channels import NORMALISED
from morgs_mi.render.rasterize import Image, rasterize, render_view
from morgs_mi.render.region import Region
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.surfaces.surface_view import Crop, SurfaceView

Columns = dict[str, list[Float]]


def composite(
    gaussians: ActivatedGaussians,
    channels: Sequence[str],
    background: Sequence[float] | Jit | None,
    view: SurfaceView,
    config: RenderConfig,
) -> Columns:
    """Return the channels of splats and surfaces, differentiable in both, each a list of floats
    [P].

    Colour is linear light. Alpha is 1 where a surface or the environment is seen. Depth is the
    expected depth of splats and surfaces together. Motion and the channels of attributes belong to
    the splats in front of the surfaces.

    Args:
        gaussians: N Gaussians.
        channels: as for `rasterize`.
        background: colour [3] behind all splats where no surface and no environment is seen,
            encoded like the splats.
        view: the surfaces on P pixels of a camera's image.
        config: settings of the rasteriser.
    """
    encode = encode_traced if view.srgb else mi.Color3f
    decode = decode_traced if view.srgb else mi.Color3f
    channels = tuple(dict.fromkeys(("color", "alpha", *channels)))
    image = rasterize(gaussians, view.pixels.camera, channels, config=config)
    crop = view.pixels.crop
    whole = _blended(image, channels, lambda image: cropped(image, crop))
    front = _in_front(gaussians, channels, view, config) or whole
    f = view.coverage
    has_surface = view.coverage > 0
    t_front = 1 - front["alpha"][0]
    t_whole = 1 - whole["alpha"][0]

    has_environment = view.behind is not None
    E = view.behind if has_environment else mi.Color3f(0)
    ground = mi.Color3f(0 if background is None or has_environment else background)
    L = mi.Color3f([view.image[:, :, k].array for k in range(3)])
    # Rays of its own find the coverage. Without splats, the two parts add up to L whatever it is.
    # The divisors are vectors: Dr.Jit divides a vector by a scalar by the rounded reciprocal.
    surface = dr.maximum(L - (1 - f) * E, 0) / mi.Color3f(dr.select(has_surface, f, 1))
    rest = dr.maximum(L - f * surface, 0) / mi.Color3f(dr.select(f < 1, 1 - f, 1))
    inner_color = decode(dr.fma(t_front, encode(surface), mi.Color3f(front["color"])))
    outer_color = decode(dr.fma(t_whole, encode(rest) + ground, mi.Color3f(whole["color"])))
    color = dr.fma(f, inner_color - outer_color, outer_color)

    splats = {
        name: [dr.lerp(b, a, f) for a, b in zip(front[name], whole[name], strict=True)]
        for name in channels
    }
    (alpha,) = splats["alpha"]
    if "depth" in channels:
        (depth,) = splats["depth"]
        weight = alpha + f * t_front
        splats["depth"] = _ratio(
            [depth + f * t_front * dr.select(has_surface, view.depth, 0)], weight
        )
    if "motion" in channels:
        splats["motion"] = _ratio(splats["motion"], alpha)
    opaque = mi.Float(1) if has_environment else dr.fma(f, t_whole, 1 - t_whole)
    return {**splats, "color": [*color], "alpha": [opaque]}


def _in_front(
    gaussians: ActivatedGaussians,
    channels: tuple[str, ...],
    view: SurfaceView,
    config: RenderConfig,
) -> Columns | None:
    """Return the blended sums of the splats in front of the surfaces [P], 0 where there are none;
    None: nowhere.

    Only the blocks of pixels in which a surface is seen are drawn.
    """
    camera = view.pixels.camera
    pixels = view.pixels.crop.slices
    limit = np.full((camera.height, camera.width), np.inf, np.float32)
    limit[pixels] = np.array(view.depth).reshape(limit[pixels].shape)
    mask = np.isfinite(limit)
    if not mask.any():
        return None
    region = Region.of(mask)
    part = render_view(gaussians, ActiveView(camera, config, region), channels, depth_limit=limit)
    index_image = region.uncropped(np.arange(region.num_pixels).reshape(region.shape(1)[:3]))
    index = from_numpy(mi.UInt32, index_image[pixels])
    has_surface = view.coverage > 0

    return _blended(
        part,
        channels,
        lambda image: read_columns(image.array, index, image.shape[-1], has_surface),
    )


def _blended(
    image: Image, channels: tuple[str, ...], columns: Callable[[Tensor], list[Float]]
) -> Columns:
    """Return the columns of every channel as sums weighted by T alpha."""
    values = {name: columns(image[name]) for name in channels}
    (alpha,) = values["alpha"]
    return {
        name: [v * alpha for v in value] if name in NORMALISED else value
        for name, value in values.items()
    }


def cropped(image: Tensor, crop: Crop) -> list[Float]:
    """Return the columns [P] of an image [H, W, C] on a crop."""
    return [image[(*crop.slices, k)].array for k in range(image.shape[2])]


def _ratio(sums: list[Float], weight: Float) -> list[Float]:
    return [dr.select(weight > 0, value / dr.maximum(weight, 1e-8), 0) for value in sums]

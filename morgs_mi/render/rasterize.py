"""`rasterize` and `render_view`, the public calls of the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from math import prod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import float_tensor, refuse_freezing
from morgs_mi.core.camera import OF_SENSOR, Camera
from morgs_mi.core.gaussians import ActivatedGaussians, repeat_each
from morgs_mi.core.types import Bool, Float, Jit, Tensor, Tensors
from morgs_mi.platform.checks import check_type, kind_of, numbers, require
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.memory import check_memory
from morgs_mi.platform.png import png_bytes
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.backend import block_shape
from morgs_mi.render.background import backdrops, over
from morgs_mi.render.blocks import BlockLists, build_lists, touches
from morgs_mi.render.channels import NORMALISED, channel_sizes, required_attributes
from morgs_mi.render.compositing import Layout, blend
from morgs_mi.render.kernel_recording import with_render_lock
from morgs_mi.render.loops import Channel
from morgs_mi.render.projection import FARTHEST, Splats, project
from morgs_mi.render.region import DrawnBlocks, full_view
from morgs_mi.render.render_config import RenderConfig

# Beside the channels color, depth, motion and confidence, a record then takes seven packets of 4
# floats.
_MOST_FEATURES = 12
# Pixels from which the free memory is compared with what an image takes, and bytes of a pixel.
_LARGE = 2**22
_PIXEL_BYTES = 60
# Checked once and not in every call.
_DEFAULT_CONFIG = RenderConfig()


@dataclass(frozen=True)
class Image:
    """Tensors of one view, one per requested channel; H rows, W columns.

    ``image["color"]`` is `image.color`, and so on for every channel. For a sequence of V cameras,
    all tensors are [V, H, W, C] instead of [H, W, C]. On a region all tensors are [A, block_height,
    block_width, C] instead of [H, W, C], and 0 outside the view.

    Attributes:
        color: display-referred colour [H, W, 3].
        alpha: 1 - transmittance [H, W, 1].
        depth: expected camera-space z [H, W, 1], world units; 0 where nothing is drawn.
        motion: displacement since the previous frame [H, W, 2], px, x_t - x_{t-1} (eq. 6); 0 where
            nothing is drawn.
        confidence: blended motion confidence [H, W, 1].
        features: blended features [H, W, F].
        others: blended channels of further attributes, by name.
    """

    color: Tensor = None
    alpha: Tensor = None
    depth: Tensor = None
    motion: Tensor = None
    confidence: Tensor = None
    features: Tensor = None
    others: Tensors = field(default_factory=dict)

    def __getitem__(self, channel: str) -> Tensor:
        """Return the tensor of a channel.

        Raises:
            KeyError: the image was rendered without that channel.
        """
        values = {**vars(self), "others": None, **self.others}
        tensors = {name: value for name, value in values.items() if value is not None}
        if channel not in tensors:
            raise KeyError(
                f"Image: expected a channel out of {', '.join(tensors)}, got {channel!r}; render "
                "it."
            )
        return tensors[channel]

    def _repr_png_(self) -> bytes | None:
        """Return the colour as a PNG file, which notebooks show; None without a colour, or on a
        region.
        """
        if self.color is None or len(self.color.shape) != 3:
            return None
        color = np.clip(np.nan_to_num(np.array(dr.detach(self.color))), 0, 1)
        return png_bytes(np.rint(255 * color).astype(np.uint8))


@with_render_lock
def rasterize(
    gaussians: ActivatedGaussians,
    camera: Camera | Sequence[Camera],
    channels: Sequence[str] = ("color", "alpha"),
    background: Sequence[float] | Jit | None = None,
    features: Tensor | np.ndarray | None = None,
    config: RenderConfig | None = None,
) -> Image:
    """Render Gaussians by depth-ordered alpha blending (eq. 1), differentiably.

    `dr.backward` and `dr.forward` give the derivatives with respect to every attribute of
    `gaussians`, and to the pose if `camera.viewmat` is a Dr.Jit tensor. Channels that are not
    requested are neither traced nor computed. `render_view` draws a part of a view, or splats that
    surfaces hide.

    Args:
        gaussians: N Gaussians, usually a `Gaussians`, or any object with its activated attributes.
        camera: the view; or V >= 1 views of the same size, which are drawn together.
        channels: out of ``color``, ``alpha``, ``depth``, ``motion``, ``guided_motion`` (motion
            without the learned offset), and the channels of the table of attributes
            (``confidence``). Colour and the channels of attributes are sums weighted by T alpha;
            depth and motion are divided by the sum of those weights.
        background: display-referred colour [3] behind all Gaussians, or an image of them in the
            shape of the result's; None: the image of the camera, or the colour of `config`. A
            Dr.Jit array gets gradients.
        features: [N, F], further values to blend like a colour, returned as `Image.features`; F is
            at most 12.
        config: cut-offs and block shape.

    Example:
        >>> image = morgs_mi.rasterize(gaussians, camera, channels=("color", "depth"))
        >>> dr.backward(dr.mean(dr.square(image.color - target), axis=None))

    Returns:
        An `Image` with one tensor per requested channel.

    Raises:
        ValueError: an image that does not fit in memory, cameras of different sizes, an unknown
            channel, a channel with a missing attribute, NaN or infinite attributes or poses, values
            above 1e18 to blend, or a call inside a function under `dr.freeze`.

    Equal depths are blended in the order of the input. A quaternion of length 0 is the identity.
    Gaussians nearer than the camera's near plane or beyond 1e18 units, and those that overflow
    float32 once projected, are not drawn. There is no antialiasing beyond `eps2d`, and lens
    distortion is not removed.

    Threads may share Gaussians; they render one after the other. Where one thread renders while
    another one computes derivatives, hold `render_lock` around `dr.backward` and `dr.forward`:
    Dr.Jit 1.5 can deadlock otherwise.
    """
    place = "rasterize()"
    refuse_freezing(place)
    config = config_or_default(place, config, _DEFAULT_CONFIG)
    _check_scene(place, gaussians, channels)
    is_stack = isinstance(camera, Sequence)
    cameras = tuple(camera) if is_stack else (camera,)
    _check_cameras(place, cameras)
    size = (cameras[0].height, cameras[0].width)
    shape = (len(cameras), *size) if is_stack else size
    if background is None:
        images = backdrops(cameras, config)
        background = config.background if images is None else np.stack(images)
    else:
        _check_background(place, background, (*shape, 3))
    table = _feature_table(place, features, gaussians)
    output = Output(_all_channels(channels, table), (), config, shape)
    region = full_view(*cameras[0].size, block_shape(config), len(cameras), mi.variant())
    if not int(gaussians.means.shape[0]):
        return _nothing(output, table, region, background)
    parts = [project(gaussians, part, output.blended, config, None, table) for part in cameras]
    splats = parts[0] if len(parts) == 1 else _stacked(parts)
    dr.schedule(splats)
    _check_finite(splats.finite, gaussians, cameras, table)
    return draw(output, splats, splats, region, background)[0]


@with_render_lock
def render_view(
    gaussians: ActivatedGaussians,
    view: ActiveView,
    channels: Sequence[str] = ("color",),
    background: Sequence[float] | Jit | None = None,
    features: Tensor | np.ndarray | None = None,
    detach_weights: Sequence[str] = (),
    depth_limit: Tensor | np.ndarray | None = None,
    means2d: Tensor | None = None,
) -> Image:
    """Render Gaussians in an active view, differentiably, as `rasterize` does.

    Args:
        gaussians: N Gaussians. Those that touch none of the view's blocks are only projected.
        view: camera and settings, the blocks that are drawn, and static splats beside the
            Gaussians, which must have the channels and have features of 0.
        channels: as for `rasterize`.
        background: as for `rasterize`, an image of the drawn pixels; None: the view's.
        features: as for `rasterize`.
        detach_weights: channels with a gradient that reaches only the blended values, not opacity
            and geometry.
        depth_limit: [H, W], the camera-space z of every pixel at which an opaque surface ends its
            ray, world units; inf where there is none. A Gaussian around that depth is drawn in
            part: by the fraction of its optical depth that the ray has passed. The limit gets no
            gradient. None: no limit, and no cost.
        means2d: zeros [N, 4] with gradients enabled. `dr.backward` gives them the gradient with
            respect to the projected mean in pixels (two columns), and the sums of its absolute
            values over the pixels (two columns), by which density control may choose parents. Only
            for a whole view without static splats and `depth_limit`. None: no cost.

    Example:
        >>> view = morgs_mi.ActiveView(camera)
        >>> probe = dr.zeros(mi.TensorXf, (len(gaussians), 4))
        >>> dr.enable_grad(probe)
        >>> image = morgs_mi.render_view(gaussians, view, means2d=probe)

    Returns:
        An `Image` with one tensor per requested channel. On a region, the drawn pixels and their
        gradients equal the full computation's.

    Raises:
        ValueError: as for `rasterize`; or static splats together with a depth limit, a depth limit
            with gradients enabled, or `means2d` with a region, static splats or a depth limit.
    """
    place = "render_view()"
    refuse_freezing(place)
    check_type(place, "view", view, ActiveView, "pass morgs_mi.ActiveView(camera)")
    _check_scene(place, gaussians, channels, detach_weights)
    camera = view.camera
    _check_cameras(place, (camera,))
    region = view.region or full_view(*camera.size, view.grid.block, 1, mi.variant())
    if background is None:
        background = view.background
    else:
        _check_background(place, background, region.shape(3))
    table = _feature_table(place, features, gaussians)
    shape = region.shape(0)[:-1]
    output = Output(_all_channels(channels, table), tuple(detach_weights), view.config, shape)
    projected = output.blended
    limits = None
    if depth_limit is not None:
        limits = _depth_limits(place, depth_limit, view)
        projected = (*projected, "profile")
    if means2d is not None:
        _check_means2d(place, means2d, gaussians, view, depth_limit)
    if not int(gaussians.means.shape[0]):
        return _nothing(output, table, region, background)
    rows = None
    if not region.whole and view.static_splats is None:
        # Those that touch no block are not blended.
        with dr.suspend_grad():
            bare = project(dr.detach(gaussians), camera, (), view.config)
            visible = touches(bare, region)
            dr.schedule(visible)
            _check_finite(bare.finite, gaussians, [camera], table)
            rows = dr.compress(visible)
        if not dr.width(rows):
            return _nothing(output, table, region, background)
    splats = project(gaussians, camera, projected, view.config, rows, table)
    absolute: tuple[Float, ...] = ()
    if means2d is not None:
        probe: Any = dr.gather(mi.Vector4f, means2d.array, dr.arange(mi.UInt32, len(splats)))
        absolute = (probe.z, probe.w)
        splats = replace(splats, mean=splats.mean + probe.xy)
    dr.schedule(splats)
    _check_finite(splats.finite, gaussians, [camera], table)
    static = view.static_splats
    drawn = splats
    if static is not None:  # these get no gradients
        with dr.suspend_grad():
            drawn = splats.concatenated_with(static.alone)
    return draw(output, splats, drawn, region, background, limits, absolute)[0]


@dataclass(frozen=True)
class Output:
    """Image that splats are drawn to."""

    channels: tuple[str, ...]  #: The requested channels.
    detach_weights: tuple[str, ...]  #: Those with a gradient that reaches only the blended values.
    config: RenderConfig  #: Cut-offs and block shape.
    shape: tuple[int, ...]  #: Of its tensors, without the axis of the channel.

    @property
    def blended(self) -> tuple[str, ...]:
        """The channels that are blended: all but alpha."""
        return tuple(name for name in self.channels if name != "alpha")


def draw(
    output: Output,
    splats: Splats,
    drawn: Splats,
    region: DrawnBlocks,
    background: Sequence[float] | Jit | None = None,
    limits: Float | None = None,
    absolute: tuple[Float, ...] = (),
) -> tuple[Image, BlockLists]:
    """Return the image of splats on a region, and their lists.

    Args:
        output: description of the image.
        splats: the splats that get gradients.
        drawn: these, and perhaps static ones after them.
        region: the blocks to draw.
        background: as for `rasterize`.
        limits: flat depth limits of the pixels of the view.
        absolute: two columns that are not read, and whose gradients are the sums of the absolute
            gradients of the means over the pixels; empty: none.
    """
    blended = output.blended
    with dr.suspend_grad():
        lists = build_lists(drawn, drawn.columns(blended), region, output.config, limits)
    sizes = {**{name: len(splats.channels[name]) for name in blended}, "alpha": 1}
    # Divided by the sum of the weights, or composited by it over the background.
    weighted = NORMALISED if background is None else (*NORMALISED, "color")
    read_alpha = [name for name in output.channels if name in ("alpha", *weighted)]
    layout = Layout(
        tuple(Channel(sizes[name], name not in output.detach_weights) for name in blended),
        bool(read_alpha),
        any(name not in output.detach_weights for name in read_alpha),
        output.config,
        limits is not None,
        bool(absolute),
    )
    values = [*splats.geometry, *splats.columns(blended), *absolute]
    images = blend(values, region, lists, layout)
    images = dict(zip((*blended, "alpha", "coverage"), images, strict=False))
    coverage = images.pop("coverage", None)
    for name in blended:
        if name in weighted:
            weight = dr.detach(coverage) if name in output.detach_weights else coverage
            weight = repeat_each(weight, sizes[name])
            if name in NORMALISED:  # 0 where nothing is drawn
                images[name] = dr.select(weight > 0, images[name] / dr.maximum(weight, 1e-8), 0)
            else:
                images[name] = over(background, images[name], weight)
    tensors = {
        name: mi.TensorXf(
            region.within_view(images[name], sizes[name]), (*output.shape, sizes[name])
        )
        for name in output.channels
    }
    return _image(tensors), lists


def _image(tensors: Tensors) -> Image:
    """Return the image with these tensors, by the names of their channels."""
    others = dict(tensors)
    channels = {f.name: others.pop(f.name) for f in fields(Image) if f.name in others}
    return Image(**channels, others=others)


def _stacked(parts: list[Splats]) -> Splats:
    """Return the splats of all views, which were projected one by one to share a kernel."""
    for v, part in enumerate(parts):
        parts[v] = replace(part, view=dr.full(mi.UInt32, v, len(part)))
        dr.eval(vars(parts[v]))
    while len(parts) > 1:
        pairs = zip(parts[::2], parts[1::2], strict=False)
        parts = [a.concatenated_with(b) for a, b in pairs] + parts[len(parts) & ~1 :]
    return parts[0]


def _nothing(
    output: Output, features: Tensor | None, region: DrawnBlocks, background: Any
) -> Image:
    """Return the image where no Gaussian is drawn."""
    sizes = {**channel_sizes(), "alpha": 1}
    if features is not None:
        sizes["features"] = int(features.shape[1])
    images = {name: dr.zeros(mi.TensorXf, (*output.shape, sizes[name])) for name in output.channels}
    if background is not None and "color" in images:
        shape = (*output.shape, 3)
        zeros = dr.zeros(mi.Float, prod(shape))
        color = region.within_view(over(background, zeros, zeros), 3)
        images["color"] = mi.TensorXf(color, shape)
    return _image(images)


def _all_channels(channels: Sequence[str], features: Tensor | None) -> tuple[str, ...]:
    """Return the channels of an image, with that of the features if there are any."""
    names = tuple(dict.fromkeys(channels))
    return names if features is None else (*names, "features")


# ---- checks of the arguments


def _check_scene(
    place: str,
    gaussians: ActivatedGaussians,
    channels: Sequence[str],
    detach_weights: Sequence[str] = (),
) -> None:
    """Raise an error unless Gaussians have channels, and the variant can differentiate them."""
    kind = f"a {type(gaussians).__name__}"
    require(hasattr(gaussians, "means"), place, "`gaussians` must be Gaussians", kind, "pass some")
    require(
        mi.variant() and dr.is_jit_v(mi.Float) and dr.is_diff_v(mi.Float),
        place,
        "expected a Mitsuba variant such as 'llvm_ad_rgb' or 'cuda_ad_rgb'",
        repr(mi.variant()),
        "call mi.set_variant() first",
    )
    required = required_attributes()
    choices = ("alpha", *required)
    for argument, names, allowed in (
        ("channels", channels, choices),
        ("detach_weights", detach_weights, (*choices, "features")),
    ):
        require(
            isinstance(names, Sequence) and not isinstance(names, str),
            place,
            f"`{argument}` must be a sequence of names",
            repr(names),
            "pass a tuple",
        )
        unknown = sorted({*map(repr, names)} - {*map(repr, allowed)})
        require(
            not unknown,
            place,
            f"`{argument}` must be out of {', '.join(allowed)}",
            ", ".join(unknown),
            "use one of these, or pass other values as `features`",
        )
    for name in channels:
        attribute = required.get(name)
        if attribute is not None:
            require(
                getattr(gaussians, attribute.activated_name, None) is not None,
                place,
                f"channel {name!r} requires Gaussians with `{attribute.name}`",
                "none",
                "set it or remove the channel",
            )


def _check_cameras(place: str, cameras: Sequence[Camera]) -> None:
    """Raise an error unless there are cameras of one size, and memory for their images."""
    require(cameras, place, "`camera` must be one or more cameras", "an empty sequence", "pass one")
    for camera in cameras:
        check_type(place, "camera", camera, Camera, OF_SENSOR)
    sizes = [*dict.fromkeys(f"{camera.width}x{camera.height}" for camera in cameras)]
    require(
        len(sizes) == 1,
        place,
        "`camera` must be cameras of the same size",
        " and ".join(sizes),
        "render one camera at a time",
    )
    V = len(cameras)
    pixels = V * prod(cameras[0].size)
    require(
        pixels <= 2**28,
        place,
        "the image must have at most 2^28 pixels",
        f"{V} times {sizes[0]}",
        "render it in tiles, one camera each",
    )
    if pixels >= _LARGE:
        content = f"{V} x {sizes[0]} pixels"
        remedy = "render a smaller image, or tiles, one camera each"
        check_memory(place, _PIXEL_BYTES * pixels, content, remedy)


def _feature_table(
    place: str, features: Tensor | np.ndarray | None, gaussians: ActivatedGaussians
) -> Tensor | None:
    """Return features [N, F] as a tensor."""
    if features is None:
        return None
    table: Tensor = float_tensor(place, "features", features)
    shape = tuple(table.shape)
    N = int(gaussians.means.shape[0])
    require(
        len(shape) == 2 and shape[0] == N and 1 <= shape[1] <= _MOST_FEATURES,
        place,
        f"`features` must be [N, F] with N={N} and F from 1 to {_MOST_FEATURES}",
        list(shape),
        "blend more in several calls",
    )
    return table


def _depth_limits(place: str, depth_limit: Tensor | np.ndarray, view: ActiveView) -> Float:
    """Return the depth limits of a view's pixels, flat and finite: a limit at infinity is one
    beyond all Gaussians.
    """
    depths: Tensor = float_tensor(place, "depth_limit", depth_limit)
    shape = (view.camera.height, view.camera.width)
    is_image = tuple(depths.shape) == shape
    require(
        is_image and not dr.any(dr.isnan(depths.array)),
        place,
        f"`depth_limit` must be one depth per pixel, {list(shape)}",
        "NaN" if is_image else list(depths.shape),
        "use inf where there is no surface",
    )
    require(
        view.static_splats is None,
        place,
        "`depth_limit` must be None where `static_splats` are given",
        "both",
        "their depth along a ray is not stored",
    )
    require(
        not dr.grad_enabled(depths),
        place,
        "`depth_limit` must not be attached to a gradient graph, because it gets no gradient",
        "one with gradients enabled",
        "pass dr.detach(depth_limit)",
    )
    return dr.clip(depths.array, -FARTHEST, FARTHEST)


def _check_background(place: str, background: Any, shape: tuple[int, ...]) -> None:
    """Raise an error unless a background is a colour, or an image of a shape."""
    if dr.is_tensor_v(background) and tuple(background.shape) == shape:
        return  # the pixels of a tensor are not read
    values = np.squeeze(background) if dr.is_array_v(background) else background
    require(
        np.shape(values) in ((3,), shape)
        and (np.abs(numbers(place, "background", values), dtype=float) <= FARTHEST).all(),
        place,
        f"`background` must be three finite numbers of at most 1e18, or an image {list(shape)}",
        kind_of(values) if np.ndim(values) > 1 else repr(values),
        "pass a colour, an image or None",
    )


def _check_means2d(
    place: str, means2d: Tensor, gaussians: ActivatedGaussians, view: ActiveView, depth_limit: Any
) -> None:
    """Raise an error unless the means of a view can be probed."""
    N = int(gaussians.means.shape[0])
    require(
        isinstance(means2d, mi.TensorXf) and tuple(means2d.shape) == (N, 4),
        place,
        f"`means2d` must be a tensor of zeros [{N}, 4]",
        f"a {type(means2d).__name__} {list(np.shape(means2d))}",
        f"use dr.zeros(mi.TensorXf, ({N}, 4))",
    )
    others = {
        "region": view.region,
        "static_splats": view.static_splats,
        "depth_limit": depth_limit,
    }
    for name, value in others.items():
        require(
            value is None,
            place,
            f"`{name}` must be None with `means2d`",
            "one",
            "render the whole view of one camera",
        )


def check_rendering(
    gaussians: ActivatedGaussians, camera: Camera, channels: tuple[str, ...], config: RenderConfig
) -> None:
    """Raise the error of `rasterize` about Gaussians that are not finite, for those that were drawn
    without it.

    Raises:
        ValueError: an attribute is not finite, or too large to be blended.
    """
    with dr.suspend_grad():
        finite = project(gaussians, camera, channels, config).finite
        _check_finite(finite, gaussians, [camera], None)


def _check_finite(
    finite: Bool, gaussians: ActivatedGaussians, cameras: Sequence[Camera], features: Tensor | None
) -> None:
    """Raise an error if a projected Gaussian is not finite because its attributes, or the pose, are
    not.

    Values that are blended must also be at most 1e18, beyond which their squares and gradients
    overflow.
    """
    count: Any = dr.count(~finite)  # in fewer launches than `dr.all`
    if not count[0]:
        return
    attributes = [row.activated_name for row in required_attributes().values() if row is not None]
    blended_names = ("sh_coeffs", *attributes)
    names = ("means", "scales", "quats", "opacities", *blended_names)
    values = [
        *(("camera.viewmat", camera.viewmat) for camera in cameras),
        *((name, getattr(gaussians, name, None)) for name in names),
        ("features", features),
    ]
    for name, value in values:
        if value is None:
            continue
        most = FARTHEST if name in (*blended_names, "features") else np.inf
        array = np.asarray(dr.detach(value))
        bad = np.argwhere(~(np.isfinite(array) & (np.abs(array) <= most)))
        if len(bad):
            worst = array[tuple(bad[0])]
            limit = "at most 1e18" if np.isfinite(worst) else "finite"
            index = ", ".join(map(str, bad[0]))
            raise ValueError(
                f"rasterize(): `{name}` must be {limit}, got {worst:g} at [{index}] ({len(bad)} "
                "such values); correct them, or lower the learning rate."
            )

"""`rasterize`, the public call of the renderer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import prod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.attributes import BY_ACTIVATED_NAME
from morgs_mi.core.camera import OF_SENSOR, Camera
from morgs_mi.core.checks import check_type, kind_of, numbers
from morgs_mi.core.gaussians import ActivatedGaussians, repeat_each
from morgs_mi.core.memory import check_memory, float_tensor, from_numpy, refuse_freezing
from morgs_mi.core.png import png_bytes
from morgs_mi.core.types import Bool, Float, Jit, Tensor, Tensors
from morgs_mi.render.backend import block_shape, elements
from morgs_mi.render.blocks import build_lists, touches
from morgs_mi.render.channels import NORMALISED, attribute_channels, channel_sizes
from morgs_mi.render.compositing import Layout, blend
from morgs_mi.render.kernel_recording import with_render_lock
from morgs_mi.render.loops import Channel
from morgs_mi.render.projection import FARTHEST, Splats, project
from morgs_mi.render.region import Region, full_view
from morgs_mi.render.render_config import RenderConfig

# Beside the channels color, depth, motion and confidence, a record then takes seven packets of 4
# floats.
_MOST_FEATURES = 12
# Pixels from which the free memory is compared with what an image takes, and bytes of a pixel.
_LARGE = 2**22
_PIXEL_BYTES = 60


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
    detach_weights: Sequence[str] = (),
    region: Region | None = None,
    features: Tensor | np.ndarray | None = None,
    static_splats: Splats | None = None,
    config: RenderConfig | None = None,
    depth_limit: Tensor | np.ndarray | None = None,
    means2d: Tensor | None = None,
) -> Image:
    """Render Gaussians by depth-ordered alpha blending (eq. 1), differentiably.

    `dr.backward` and `dr.forward` give the derivatives with respect to every attribute of
    `gaussians`, and to the pose if `camera.viewmat` is a Dr.Jit tensor. Channels that are not
    requested are neither traced nor computed.

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
        detach_weights: channels with a gradient that reaches only the blended values, not opacity
            and geometry.
        region: the blocks of pixels to draw; None: the whole view. Gaussians that touch none of its
            blocks are only projected.
        features: [N, F], further values to blend like a colour, returned as `Image.features`; F is
            at most 12.
        static_splats: further splats of this view that are drawn and get no gradients; they must
            have the channels.
        config: cut-offs and block shape.
        depth_limit: [H, W], the camera-space z of every pixel at which an opaque surface ends its
            ray, world units; inf where there is none. A Gaussian around that depth is drawn in
            part: by the fraction of its optical depth that the ray has passed. The limit gets no
            gradient. None: no limit, and no cost.
        means2d: zeros [N, 4] with gradients enabled. `dr.backward` gives them the gradient with
            respect to the projected mean in pixels (two columns), and the sums of its absolute
            values over the pixels (two columns), by which density control may choose parents. Only
            for one whole view without `static_splats` and `depth_limit`. None: no cost.

    Example:
        >>> image = morgs_mi.rasterize(gaussians, camera, channels=("color", "depth"))
        >>> dr.backward(dr.mean(dr.square(image.color - target), axis=None))

    Returns:
        An `Image` with one tensor per requested channel. On a region, the drawn pixels and their
        gradients equal the full computation's.

    Raises:
        ValueError: an image that does not fit in memory, cameras of different sizes, or several
            with a region, static splats or a depth limit, an unknown channel, a channel with a
            missing attribute, NaN or infinite attributes or poses, values above 1e18 to blend, a
            region of another view or block shape, `static_splats` together with a depth limit, a
            depth limit with gradients enabled, or a call inside a function under `dr.freeze`.

    Equal depths are blended in the order of the input. A quaternion of length 0 is the identity.
    Gaussians nearer than the camera's near plane or beyond 1e18 units, and those that overflow
    float32 once projected, are not drawn. There is no antialiasing beyond `eps2d`, and lens
    distortion is not removed.

    Threads may share Gaussians; they render one after the other. Where one thread renders while
    another one computes derivatives, hold `render_lock` around `dr.backward` and `dr.forward`:
    Dr.Jit 1.5 can deadlock otherwise.
    """
    refuse_freezing("rasterize()")
    config = RenderConfig() if config is None else config
    is_stack = isinstance(camera, Sequence)
    cameras = tuple(camera) if is_stack else (camera,)
    options = {
        "background": background,
        "features": features,
        "config": config,
        "region": region,
        "static_splats": static_splats,
        "depth_limit": depth_limit,
        "means2d": means2d,
    }
    for problem in _problems(gaussians, cameras, channels, detach_weights, options, is_stack):
        raise ValueError(f"rasterize(): {problem}.")
    channels = tuple(dict.fromkeys(channels))
    sizes = {**channel_sizes(), "alpha": 1}
    view = cameras[0]
    if features is not None:
        table = float_tensor("rasterize()", "features", features)
        features = table
        sizes["features"] = int(table.shape[1])
        channels = (*channels, "features")
    limits = None
    if depth_limit is not None:  # finite: a limit at infinity is one beyond all Gaussians
        depths = float_tensor("rasterize()", "depth_limit", depth_limit)
        limits = dr.clip(depths.array, -FARTHEST, FARTHEST)
    if region is None:
        region = full_view(view.width, view.height, block_shape(config), len(cameras), mi.variant())
    if background is None:
        background = config.background
        if (images := backdrops(cameras, config)) is not None:
            background = np.stack(images) if is_stack else images[0]
            background = background if region.whole else region.crop(images[0])
    stack = (len(cameras), view.height, view.width) if is_stack else region.shape(0)[:-1]
    blended = tuple(c for c in channels if c != "alpha")
    cut = limits is not None
    projected = (*blended, "profile") if cut else blended
    rows = None
    if not int(gaussians.means.shape[0]):
        rows = mi.UInt32()
    elif not region.whole and static_splats is None:  # those that touch no block are not blended
        with dr.suspend_grad():
            bare = project(dr.detach(gaussians), view, (), config)
            visible = touches(bare, region)
            dr.schedule(visible)
            _check_finite(bare.finite, gaussians, cameras, features)
            rows = dr.compress(visible)
    if rows is not None and not dr.width(rows):
        images = {name: dr.zeros(mi.TensorXf, (*stack, sizes[name])) for name in channels}
        if background is not None and "color" in images:
            zeros = dr.zeros(mi.Float, prod((*stack, 3)))
            images["color"] = _tensor(over(background, zeros, zeros), region, (*stack, 3))
        return _image(images)
    parts = [project(gaussians, part, projected, config, rows, features) for part in cameras]
    splats = parts[0] if len(parts) == 1 else _stacked(parts)
    if static_splats is not None:
        splats = splats.concatenated_with(static_splats)
    absolute: Sequence[Float] = ()
    if means2d is not None:
        lane = dr.arange(mi.UInt32, len(splats)) * 4
        x, y, *absolute = (dr.gather(mi.Float, means2d.array, lane + k) for k in range(4))
        mean_x, mean_y, *others = splats.shape
        splats = replace(splats, shape=(mean_x + x, mean_y + y, *others))
    dr.schedule(splats.geometry, splats.channels, splats.depths, splats.extent, splats.valid)
    _check_finite(splats.finite, gaussians, cameras, features)
    values = [splats.channels[name] for name in blended]
    with dr.suspend_grad():
        lists = build_lists(
            splats, [column for columns in values for column in columns], region, config, limits
        )
    # Divided by the sum of the weights, or composited by it over the background.
    weighted = [*NORMALISED, *(["color"] if background is not None else [])]
    read_alpha = [name for name in channels if name in ("alpha", *weighted)]
    layout = Layout(
        tuple(Channel(sizes[name], name not in detach_weights) for name in blended),
        bool(read_alpha),
        any(name not in detach_weights for name in read_alpha),
        config,
        cut,
        means2d is not None,
    )
    outputs = blend(splats.geometry, values, region, lists, layout, tuple(absolute))
    images = dict(zip((*blended, "alpha", "coverage"), outputs, strict=False))
    coverage = images.pop("coverage", None)
    for name in blended:
        if name in weighted:
            weight = dr.detach(coverage) if name in detach_weights else coverage
            weight = repeat_each(weight, sizes[name])
            if name in NORMALISED:  # 0 where nothing is drawn
                images[name] = dr.select(weight > 0, images[name] / dr.maximum(weight, 1e-8), 0)
            else:
                images[name] = over(background, images[name], weight)
    return _image({name: _tensor(images[name], region, (*stack, sizes[name])) for name in channels})


def _image(tensors: Tensors) -> Image:
    """Return the image with these tensors, by the names of their channels."""
    others = dict(tensors)
    channels = {f.name: others.pop(f.name) for f in fields(Image) if f.name in others}
    return Image(**channels, others=others)


def backdrops(cameras: Sequence[Camera], config: RenderConfig) -> list[np.ndarray] | None:
    """Return the image behind all Gaussians for each camera [H, W, 3]; None if no camera has one:
    it is the colour of `config`.
    """
    images = [camera.backdrop for camera in cameras]
    if all(image is None for image in images):
        return None
    plain = np.zeros((cameras[0].height, cameras[0].width, 3), np.float32)
    plain += config.background or (0, 0, 0)
    return [plain if image is None else image for image in images]


def over(background: Sequence[float] | Jit | None, values: Float, weight: Float) -> Float:
    """Return flat colours with the sums of their weights, composited over the background."""
    color: Any = background
    if dr.is_array_v(color):
        behind = color.array if dr.is_tensor_v(color) else dr.ravel(color)
    else:
        behind = from_numpy(mi.Float, np.asarray(color, np.float32).ravel())
    if dr.width(behind) == dr.width(values):
        return dr.fma(1 - weight, behind, values)
    # Numbers of their own: the gradient of one array would be added by all pixels to three places.
    red, green, blue = (elements(behind, mi.UInt32(k)) for k in range(3))
    component = dr.arange(mi.UInt32, dr.width(weight)) % 3
    return dr.fma(
        1 - weight,
        dr.select(component == 0, red, dr.select(component == 1, green, blue)),
        values,
    )


def _stacked(parts: list[Splats]) -> Splats:
    """Return the splats of all views, which were projected one by one to share a kernel."""
    for v, part in enumerate(parts):
        parts[v] = replace(part, view=dr.full(mi.UInt32, v, len(part)))
        dr.eval(vars(parts[v]))
    while len(parts) > 1:
        pairs = zip(parts[::2], parts[1::2], strict=False)
        parts = [a.concatenated_with(b) for a, b in pairs] + parts[len(parts) & ~1 :]
    return parts[0]


def _tensor(values: Float, region: Region, shape: tuple[int, ...]) -> Tensor:
    """Return a channel's image; pixels of a region that lie outside the view are 0."""
    if region.weights is not None:
        values = values * repeat_each(region.weights, shape[-1])
    return mi.TensorXf(values, shape)


def _problems(
    gaussians: ActivatedGaussians,
    cameras: Sequence[Camera],
    channels: Sequence[str],
    detach_weights: Sequence[str],
    options: Mapping[str, Any],
    is_stack: bool,
) -> Iterator[str]:
    """Yield a sentence for each argument of `rasterize` that is refused; a later one relies on the
    earlier ones.

    Args:
        gaussians: as for `rasterize`, like `channels` and `detach_weights`.
        cameras: the view, or all of them.
        channels: to render.
        detach_weights: channels.
        options: the other arguments, by name.
        is_stack: whether a sequence of cameras was given.
    """
    if not hasattr(gaussians, "means"):
        yield f"`gaussians` must be Gaussians, got a {type(gaussians).__name__}; pass some"
    for name, names in (("channels", channels), ("detach_weights", detach_weights)):
        if isinstance(names, str) or not isinstance(names, Sequence):
            yield f"`{name}` must be a sequence of names, got {names!r}; pass a tuple"
    if mi.variant() is None or not dr.is_jit_v(mi.Float) or not dr.is_diff_v(mi.Float):
        yield (
            "expected a Mitsuba variant such as 'llvm_ad_rgb' or 'cuda_ad_rgb', got "
            f"{mi.variant()!r}; call mi.set_variant() first"
        )
    motion = BY_ACTIVATED_NAME["motion"]
    required = {"motion": motion, "guided_motion": motion, **attribute_channels()}
    choices = ("color", "alpha", "depth", *required)
    for name in (*channels, *detach_weights):
        if name not in choices and (name != "features" or name in channels):
            yield (
                f"`channels` must be out of {', '.join(choices)}, got {name!r}; use one of these, "
                "or pass other values as `features`"
            )
    for name, attribute in required.items():
        if name in channels and getattr(gaussians, attribute.activated_name, None) is None:
            yield (
                f"channel {name!r} requires Gaussians with `{attribute.name}`, got none; set it or "
                "remove the channel"
            )

    if not cameras:
        yield "`camera` must be one or more cameras, got an empty sequence; pass one"
    for camera in cameras:
        check_type("rasterize()", "camera", camera, Camera, OF_SENSOR)
    view = cameras[0]
    V = len(cameras)
    sizes = [*dict.fromkeys(f"{camera.width}x{camera.height}" for camera in cameras)]
    if len(sizes) > 1:
        yield (
            f"`camera` must be cameras of the same size, got {' and '.join(sizes)}; render one "
            "camera at a time"
        )
    pixels = V * view.width * view.height
    if pixels > 2**28:
        yield (
            f"the image must have at most 2^28 pixels, got {V} times {sizes[0]}; render it in "
            "tiles, one camera each"
        )
    if pixels >= _LARGE:
        check_memory(
            "rasterize()",
            _PIXEL_BYTES * pixels,
            f"{V} x {sizes[0]} pixels",
            "render a smaller image, or tiles, one camera each",
        )

    background, features, config, region, static_splats, depth_limit, means2d = options.values()
    check_type("rasterize()", "config", config, RenderConfig)
    for name, value, kind in (("region", region, Region), ("static_splats", static_splats, Splats)):
        if value is not None:
            check_type("rasterize()", name, value, kind)
    for name in ("region", "static_splats", "depth_limit", "means2d"):
        value = options[name]
        if is_stack and value is not None:
            yield (
                f"`{name}` must be None with a sequence of cameras, got a {type(value).__name__}; "
                "render one camera at a time"
            )
    if features is not None:
        shape = tuple(float_tensor("rasterize()", "features", features).shape)
        N = int(gaussians.means.shape[0])
        if len(shape) != 2 or shape[0] != N or not 1 <= shape[1] <= _MOST_FEATURES:
            yield (
                f"`features` must be [N, F] with N={N} and F from 1 to {_MOST_FEATURES}, got "
                f"{list(shape)}; blend more in several calls"
            )
    if depth_limit is not None:
        limits: Tensor = float_tensor("rasterize()", "depth_limit", depth_limit)
        expected = (view.height, view.width)
        if tuple(limits.shape) != expected or dr.any(dr.isnan(limits.array)):
            problem = list(limits.shape) if tuple(limits.shape) != expected else "NaN"
            yield (
                f"`depth_limit` must be one depth per pixel, {list(expected)}, got {problem}; use "
                "inf where there is no surface"
            )
        if static_splats is not None:
            yield (
                "`depth_limit` must be None where `static_splats` are given, got both; their depth "
                "along a ray is not stored"
            )
        if dr.grad_enabled(limits):
            yield (
                "`depth_limit` must not be attached to a gradient graph, because it gets no "
                "gradient, got one with gradients enabled; pass dr.detach(depth_limit)"
            )
    if region is not None:
        block = block_shape(config)
        shape = (region.width, region.height, *region.block)
        if shape != (view.width, view.height, *block):
            yield (
                f"`region` must be of a {view.width}x{view.height} view with {block[0]}x{block[1]} "
                f"blocks like the camera's and the config's, got {shape[0]}x{shape[1]} with "
                f"{shape[2]}x{shape[3]}; build it for this camera with this config"
            )
    if background is not None:
        shape = (*[V] * is_stack, *(region.shape(3) if region else (view.height, view.width, 3)))
        is_image = dr.is_tensor_v(background) and tuple(background.shape) == shape
        values = background if is_image or not dr.is_array_v(background) else np.squeeze(background)
        # The pixels of a tensor are not read.
        if not is_image and not (
            np.shape(values) in ((3,), shape)
            and (np.abs(numbers("rasterize()", "background", values)) <= FARTHEST).all()
        ):
            value = kind_of(values) if np.ndim(values) > 1 else repr(values)
            yield (
                "`background` must be three finite numbers of at most 1e18, or an image "
                f"{list(shape)}, got {value}; pass a colour, an image or None"
            )
    if means2d is not None:
        N = int(gaussians.means.shape[0])
        if not dr.is_tensor_v(means2d) or tuple(means2d.shape) != (N, 4):
            yield (
                f"`means2d` must be a tensor of zeros [{N}, 4], got a {type(means2d).__name__} "
                f"{list(np.shape(means2d))}; use dr.zeros(mi.TensorXf, ({N}, 4))"
            )
        for name in ("region", "static_splats", "depth_limit"):
            if options[name] is not None:
                yield (
                    f"`{name}` must be None with `means2d`, got one; render the whole view of one "
                    "camera"
                )


def _check_finite(
    finite: Bool, gaussians: ActivatedGaussians, cameras: Sequence[Camera], features: Tensor | None
) -> None:
    """Raise an error if a projected Gaussian is not finite because its attributes, or the pose, are
    not.

    Values that are blended must also be at most 1e18, beyond which their squares and gradients
    overflow.
    """
    if dr.all(finite):
        return
    others = [attribute.activated_name for attribute in attribute_channels().values()]
    blended_names = ("sh_coeffs", "motion", *others)
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
            remedy = "" if name == "camera.viewmat" else "remove these Gaussians or "
            raise ValueError(
                f"rasterize(): `{name}` must be {limit}, got {worst:g} at [{index}] ({len(bad)} "
                f"such values); {remedy}lower the learning rate."
            )

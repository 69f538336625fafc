"""The class of the integrator `gaussian_splat`, see `gaussian_integrator`.

Mitsuba has a base class for every variant, so this module is imported again after mi.set_variant().
"""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import refuse_freezing
from morgs_mi.core.attributes import BY_ACTIVATED_NAME, shape_attribute_widths
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import decode_traced
from morgs_mi.core.gaussians import tensor_rows
from morgs_mi.core.types import Float, Tensor, UInt32
from morgs_mi.platform.checks import bounded, errors_at, require
from morgs_mi.platform.config import check_value
from morgs_mi.render.channels import aov_names, channel_sizes, exr_names, required_attributes
from morgs_mi.render.kernel_recording import render_lock
from morgs_mi.render.projection import AttachedCamera
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.surfaces.composite import Columns, composite, cropped
from morgs_mi.surfaces.surface_view import (
    PLACE,
    Crop,
    SampledPixels,
    SurfaceView,
    ellipsoids_of,
)

_log = logging.getLogger(__name__)

# Settings of the rasteriser that are properties of the plugin.
_SETTINGS = (
    "eps2d",
    "alpha_min",
    "stop_transmittance",
    "antialiased",
    "first_order_motion",
)


class _SceneGaussians(SimpleNamespace):
    """The Gaussians of all shapes, in the scene's order (see `ActivatedGaussians`)."""

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    sh_coeffs: Tensor
    motion: Tensor = None
    confidence: Tensor = None

    def rows(self, name: str, index: UInt32) -> list[Float]:
        """Return rows of an attribute, see `ActivatedGaussians`."""
        return tensor_rows(getattr(self, name), index)


def _scene_gaussians(scene: mi.Scene, attributes: list[str]) -> _SceneGaussians:
    """Return the Gaussians of all shapes, padded with zeros to the largest number of SH
    coefficients.
    """
    parts = [_shape_gaussians(shape, attributes) for shape in ellipsoids_of(scene)]
    K = max(part["sh_coeffs"].shape[1] for part in parts)
    for part in parts:
        N, present, _ = part["sh_coeffs"].shape
        if present < K:
            zeros = dr.zeros(mi.TensorXf, (N, K - present, 3))
            part["sh_coeffs"] = dr.concat([part["sh_coeffs"], zeros], axis=1)
    return _SceneGaussians(
        **{name: dr.concat([part[name] for part in parts], axis=0) for name in parts[0]}
    )


def _background(value: Any) -> Any:
    """Return the plugin's background: a colour, an image as it is, or None.

    Raises:
        ValueError: it is something else.
    """
    if value is None:
        return None
    values = np.ravel(value)
    is_color = values.size in (1, 3)
    require(
        (is_color or np.ndim(value) > 1) and values.dtype.kind in "fiu" and bounded(values),
        PLACE,
        "`background` must be one or three finite numbers, or an image of them",
        f"a {type(value).__name__}, {str(value)[:20]!r}",
        "pass a colour such as {'type': 'rgb', 'value': 1} or a mi.TensorXf [H, W, 3]",
    )
    return mi.Color3f(np.broadcast_to(values.astype(float), 3)) if is_color else value


def _check_surfaces(surfaces: Any, background: Any) -> None:
    """Raise an error unless an integrator can render the surfaces."""
    require(
        isinstance(surfaces, mi.Integrator) and not isinstance(surfaces, GaussianSplatIntegrator),
        PLACE,
        "`surfaces` must be an integrator of surfaces such as {'type': 'path'}",
        repr(surfaces),
        "pass another one",
    )
    require(
        background is None or isinstance(background, mi.Color3f),
        PLACE,
        "`background` must be a colour with `surfaces`",
        "an image",
        "give the scene an `envmap` emitter",
    )
    require(
        mi.is_rgb,
        PLACE,
        "with `surfaces`, expected a variant such as 'llvm_ad_rgb'",
        repr(mi.variant()),
        "call mi.set_variant() before the scene is loaded, because Gaussians have RGB colours",
    )


def _check_scene(
    scene: mi.Scene, film: mi.Film, num_views: int, border: int, with_surfaces: bool
) -> None:
    """Raise an error unless a scene can be rendered."""
    require(
        not mi.has_flag(film.flags(), mi.FilmFlags.Special),
        PLACE,
        "expected an `hdrfilm`",
        film.class_name(),
        "replace it, because only RGB is drawn",
    )
    if num_views > 1:
        views = f"a `batch` of {num_views} sensors"
        remedy = "render its sensors one by one"
        require(not border, PLACE, "expected a film without `sample_border`", views, remedy)
        require(not with_surfaces, PLACE, "expected one sensor with `surfaces`", views, remedy)
    for shape in scene.shapes():
        require(
            with_surfaces or shape.is_ellipsoids(),
            PLACE,
            "expected `ellipsoids` shapes only",
            f"{shape.class_name()} {shape.id()!r}",
            "remove it from the scene, or set `surfaces` to an integrator that renders it, such as "
            "`path`",
        )
    require(
        ellipsoids_of(scene),
        PLACE,
        "expected a scene with an `ellipsoids` shape",
        "none",
        "add one",
    )


def _shape_gaussians(shape: mi.Shape, attributes: list[str]) -> dict[str, Tensor]:
    """Return a shape's attributes by the rasteriser's names, attached to its parameters."""
    params: Any = mi.traverse(shape)
    data = mi.TensorXf(params["data"], (dr.width(params["data"]) // 10, 10))
    N = data.shape[0]
    part = {"means": data[:, :3], "scales": data[:, 3:6], "quats": data[:, mi.UInt32(9, 6, 7, 8)]}
    all_widths = shape_attribute_widths()
    for name in attributes:
        size = dr.width(params[name]) if name in params else 0
        if size not in [N * width for width in all_widths[name]]:
            expected = " or ".join(map(str, all_widths[name]))
            content = f"{size} values" if name in params else f"only {sorted(params.keys())}"
            raise ValueError(
                f"gaussian_splat: the {shape.class_name()} {shape.id()!r} must have `{name}` [N, "
                f"{expected}] with N={N}, got {content}; set it where the shape is defined, or "
                "write its file by morgs_mi.write_ply(path, gaussians, layout='mitsuba')."
            )
        tail = (size // N // 3, 3) if name == "sh_coeffs" else BY_ACTIVATED_NAME[name].shape
        part[name] = mi.TensorXf(params[name], (N, *tail))
    return part


class _ForwardPass(NamedTuple):
    """A rendering with gradients: its inputs, which must not have changed for the backward pass,
    and the image.
    """

    inputs: list[Any]
    image: Tensor

    def fits(self, inputs: list[Any]) -> bool:
        """Return whether the inputs are the same numbers and the same Dr.Jit variables as those of
        the image.
        """
        return list(map(_identity, inputs)) == list(map(_identity, self.inputs))


def _identity(leaf: Any) -> Any:
    """Return the indices of a Dr.Jit variable, or a number as it is."""
    return (leaf.index, leaf.index_ad) if dr.is_jit_v(leaf) else leaf


def _leaves(value: Any) -> list[Any]:
    """Return copies of the numbers or the one-dimensional Dr.Jit arrays in a parameter."""
    value = getattr(value, "matrix", value)  # of a transform
    if not (dr.is_array_v(value) and dr.is_jit_v(value)):
        return [str(value)]
    return (
        [leaf for part in value for leaf in _leaves(part)]
        if dr.depth_v(value) > 1
        else [type(value)(value)]
    )


def _views(sensor: mi.Sensor) -> list[mi.Sensor]:
    """Return the sensors of a `batch`, which are beside each other on its film, or the sensor
    itself.
    """
    if sensor.class_name() != "BatchSensor":
        return [sensor]
    parts: Any = mi.traverse(sensor).hierarchy
    children = [part for part, (parent, _) in parts.items() if parent is sensor]
    return [part for part in children if isinstance(part, mi.Sensor)]


def _sensor_camera(sensor: mi.Sensor, border: int) -> Camera:
    """Return the camera of the sensor's whole film with a margin of `border` pixels."""
    view = Camera.from_sensor(sensor)
    params: Any = mi.traverse(sensor)
    W = view.width
    H = view.height
    # Numbers of the view, which take no kernel of their own; Dr.Jit arrays only for their
    # gradients.
    K = view.K.copy()
    K[:2, 2] += border
    f = 0.5 * W / dr.tan(dr.deg2rad(0.5 * params["x_fov"]))
    # Mitsuba adds its offset to the pixel's position: the principal point moves the other way.
    cx = W * (0.5 - params["principal_point_offset_x"]) + border
    cy = H * (0.5 - params["principal_point_offset_y"]) + border
    world_to_sensor = mi.TensorXf(dr.rcp(params["to_world"].matrix))[..., 0]
    # Mitsuba's camera has x to the left and y up.
    viewmat = world_to_sensor * mi.TensorXf([-1, -1, 1, 1], (4, 1))
    size = (W + 2 * border, H + 2 * border)
    focal = mi.Vector2f(f)
    center = mi.Point2f(cx, cy)
    return AttachedCamera(K, viewmat, *size, view.name, view.near, focal=focal, center=center)


def _side_by_side(stack: Tensor) -> Tensor:
    """Return images [V, H, W, C] as one [H, V W, C]."""
    V, H, W, C = stack.shape
    return dr.reshape(dr.moveaxis(stack, 0, 1), (H, V * W, C))


def _sensor_of(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """Return a sensor, which may be given by its number in the scene."""
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


class GaussianSplatIntegrator(mi.CppADIntegrator):
    r"""Gaussian splatting integrator (:monosp:`gaussian_splat`).

    .. pluginparameters::

     * - srgb_primitives
       - |bool|
       - Whether the SH coefficients give sRGB-encoded colours, which reach the film as linear
         light after blending. (Default: True)

     * - background
       - |rgb| or |tensor|, |exposed|, |differentiable|
       - Colour behind all Gaussians, encoded like the primitives, or an image of such colours
         [H, W, 3] of the whole film; [V, H, W, 3] for a `batch` of V sensors. Layers are composited
         in this encoding, so encode the colours of an `rgba` film before compositing them.
         (Default: black)

     * - aovs
       - |string|
       - Further channels, a comma-separated list of `motion` (`motion.X`, `motion.Y`:
         displacement since the last frame, px), `depth` (`depth.Y`: expected z, world units) and
         the channels of attributes such as `confidence` (`confidence.Y`). Depth and motion are
         divided by the coverage, the channels of attributes are not. Channels that are not listed
         are not computed. (Default: none)

     * - eps2d, alpha_min, stop_transmittance
       - |float|
       - Cut-offs of the rasteriser, see `RenderConfig`. (Default: 0.3, 1/255, 1e-4)

     * - antialiased
       - |bool|
       - Whether small splats fade instead of growing, for models that were trained so.
         (Default: False)

     * - first_order_motion
       - |bool|
       - Whether `motion` is linear in the displacement, as in the MoRGS paper. (Default: False)

     * - surfaces
       - |integrator|
       - Integrator for the other shapes of the scene, which are blended among the splats.
         (Default: none, and other shapes are refused)

    The film's size, crop, border, reconstruction filter and pixel format are honoured; every pixel
    gets one sample at its centre. Therefore `spp`, the seeds and the sampler have no effect.
    Emitters (with a warning), the sensor's far plane and shutter, and the shapes' `extent` are
    ignored. A crop saves no time. Sensors of a `batch` share their launches.

    A rendering with gradients is kept for the backward pass until the next one; if neither the
    Gaussians nor the sensor have changed, the backward pass does not render again.

    With `surfaces`, that integrator renders the other shapes with `spp` samples; their mean is the
    pixel's sample. A pixel's splats end at the mean depth of the surfaces in it, and are blended
    twice if they cover it in part. Surfaces get no light or shadow from splats, and splats get none
    from surfaces; see docs/surfaces.md for both. The surfaces have no derivatives with respect to
    the sensor.

    Integrators around it, such as `aov` and `moment`, are refused: they need the colour of single
    rays.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        for name, kind in (("srgb_primitives", bool), ("aovs", str)):
            if name in props:
                check_value(PLACE, name, props[name], kind)
        self.srgb_primitives = props.get("srgb_primitives", True)
        with errors_at(PLACE):
            self.config = RenderConfig(**{name: props[name] for name in _SETTINGS if name in props})
        names = (name.strip() for name in props.get("aovs", "").split(","))
        self.aovs = list(dict.fromkeys(name for name in names if name))
        choices = aov_names()
        expected = f"`aovs` must be out of {', '.join(choices)}"
        for name in self.aovs:
            require(name in choices, PLACE, expected, repr(name), "separate them by commas")
        self.background = _background(props.get("background", None))
        self.surfaces = props.get("surfaces", None)
        if self.surfaces is not None:
            _check_surfaces(self.surfaces, self.background)
        self.warnings: set[str] = set()
        self.forward_pass: _ForwardPass | None = None

    def traverse(self, callback: mi.TraversalCallback) -> None:
        if self.background is not None:
            callback.put("background", self.background, mi.ParamFlags.Differentiable)

    def sample(self, *_: Any, **__: Any) -> Any:
        """Refuse to render single rays, as an integrator around this one requests.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "gaussian_splat: expected to be the scene's integrator, got an integrator around it, "
            "such as `aov` or `moment`, which needs the colour of single rays; list further "
            "channels in `aovs`, such as 'depth'."
        )

    def aov_names(self) -> list[str]:
        sizes = channel_sizes()
        return [channel for name in self.aovs for channel in exr_names(name, sizes[name])]

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Tensor:
        # Before any memory is released, which would end the process.
        refuse_freezing(PLACE)
        self.forward_pass = None
        with dr.resume_grad():
            inputs = self._inputs(scene, sensor)
            attached = develop and self.surfaces is None and dr.grad_enabled(inputs)
        with dr.resume_grad() if attached else dr.suspend_grad():
            film, _ = self._expose(scene, sensor, seed, spp)
            image = film.develop() if develop else mi.TensorXf()
        if attached:
            self.forward_pass = _ForwardPass(inputs, image)
            image = dr.detach(image)
        film.schedule_storage()
        if evaluate:
            dr.eval(image)
            dr.sync_thread()
        return image

    def render_forward(
        self,
        scene: mi.Scene,
        params: Any,
        sensor: int | mi.Sensor = 0,
        seed: UInt32 = 0,
        spp: int = 0,
    ) -> Tensor:
        with dr.resume_grad():
            film, surfaces = self._expose(scene, sensor, seed, spp)
            image = film.develop()
            if surfaces is not None:
                surfaces.forward(params)
            with render_lock:
                # The tangents of the parameters stay for other terms of the loss.
                dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
            return dr.grad(image)

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: Tensor,
        sensor: int | mi.Sensor = 0,
        seed: UInt32 = 0,
        spp: int = 0,
    ) -> None:
        forward_pass = self.forward_pass
        self.forward_pass = None
        with dr.resume_grad():
            if forward_pass is not None and forward_pass.fits(self._inputs(scene, sensor)):
                image = forward_pass.image
                surfaces = None
            else:
                film, surfaces = self._expose(scene, sensor, seed, spp)
                image = film.develop()
            dr.set_grad(image, grad_in)
            with render_lock:
                dr.backward_from(image)
            if surfaces is not None:
                surfaces.backward(params)

    def _inputs(self, scene: mi.Scene, sensor: int | mi.Sensor) -> list[Any]:
        """Return all values that an image depends on, but for the integrator's fixed settings."""
        parts = (_sensor_of(scene, sensor), *ellipsoids_of(scene))
        tables: list[Any] = [mi.traverse(part) for part in parts]
        values = [value for table in tables for _, value in table]
        return [leaf for value in [*values, self.background] for leaf in _leaves(value)]

    def _expose(
        self, scene: mi.Scene, sensor: int | mi.Sensor, seed: UInt32, spp: int
    ) -> tuple[mi.Film, SurfaceView | None]:
        """Render the scene to the sensor's film and return the film, and the surfaces if there are
        any.
        """
        sensor = _sensor_of(scene, sensor)
        film = sensor.film()
        border = film.rfilter().border_size() if film.sample_border() else 0
        views = _views(sensor)
        _check_scene(scene, film, len(views), border, self.surfaces is not None)
        cameras = [_sensor_camera(view, border) for view in views]
        has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        required = (required_attributes()[name] for name in self.aovs)
        attributes = ["opacities", "sh_coeffs", *(row.activated_name for row in required if row)]
        gaussians = _scene_gaussians(scene, attributes)
        colors = ("color", "alpha") if has_alpha else ("color",)
        channels = (*colors, *self.aovs)
        # Cropped after rendering: the projection's linearisation depends on the extent of the whole
        # view.
        crop = Crop(film.crop_offset(), film.crop_size() + 2 * border)

        self._warn(scene, gaussians)
        surfaces = None
        if self.surfaces is not None:
            pixels = SampledPixels(cameras[0], crop, sensor, seed, spp)
            surfaces = SurfaceView.of(
                scene, self.surfaces, pixels, gaussians, self.srgb_primitives, self.config
            )
        if surfaces is None:
            columns = self._splats(gaussians, cameras, channels, crop)
        else:
            columns = composite(gaussians, channels, self.background, surfaces, self.config)
        columns["weight"] = [mi.Float(1)]  # of the sample
        names = (*colors, "weight", *self.aovs)
        values = [value for name in names for value in columns[name]]

        film.prepare(self.aov_names())
        block = film.create_block()
        index = dr.arange(mi.UInt32, crop.count)
        place = mi.Point2f(index % crop.size.x, index // crop.size.x)
        block.set_coalesce(False)  # useful for many samples per pixel only
        block.put(place + mi.Point2f(crop.offset) + (0.5 - border), values)
        film.put_block(block)
        return film, surfaces

    def _splats(
        self,
        gaussians: Any,
        cameras: list[Camera],
        channels: tuple[str, ...],
        crop: Crop,
    ) -> Columns:
        """Return the channels of a scene without surfaces, colour in linear light; several views
        beside each other.
        """
        camera = cameras if len(cameras) > 1 else cameras[0]
        image = rasterize(gaussians, camera, channels, self.background, config=self.config)
        images: dict[str, Tensor] = {name: image[name] for name in channels}
        if len(cameras) > 1:
            images = {name: _side_by_side(stack) for name, stack in images.items()}
        columns = {name: cropped(value, crop) for name, value in images.items()}
        if self.srgb_primitives:
            columns["color"] = [decode_traced(value) for value in columns["color"]]
        return columns

    def _warn(self, scene: mi.Scene, gaussians: _SceneGaussians) -> None:
        """Log what the image leaves out, once."""
        if scene.emitters() and self.surfaces is None:
            self._warn_once(
                "gaussian_splat ignores the scene's emitters; set its `background` colour instead."
            )
        opacities = dr.detach(gaussians.opacities.array)
        outside: UInt32 = dr.count((opacities < 0) | (opacities > 1))
        if count := int(outside[0]):
            self._warn_once(
                "gaussian_splat: `opacities` must be in [0, 1], got %d values outside: those below "
                "0 are not drawn and get no gradient, those above 1 are cut off at full coverage; "
                "clamp them after each step.",
                count,
            )

    def _warn_once(self, sentence: str, *values: int) -> None:
        if sentence not in self.warnings:
            _log.warning(sentence, *values)
            self.warnings.add(sentence)

    def to_string(self) -> str:
        names = ("aovs", "background", "config", "srgb_primitives", "surfaces")
        values = {name: getattr(self, name) for name in names}
        if isinstance(self.background, mi.TensorXf):
            values["background"] = f"an image {[*self.background.shape]}"
        lines = ",\n".join(f"  {name} = {value}" for name, value in values.items())
        return f"GaussianSplatIntegrator[\n{lines}\n]"

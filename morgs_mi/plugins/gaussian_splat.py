"""The class of the integrator `gaussian_splat`, see `gaussian_integrator`.

Mitsuba has a base class for every variant, so this module is imported again after mi.set_variant().
"""

from __future__ import annotations

import logging
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.attributes import BY_ACTIVATED_NAME
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import decode_traced
from morgs_mi.core.gaussians import tensor_rows
from morgs_mi.core.types import Float, Tensor, UInt32
from morgs_mi.plugins.composite import composite, cropped
from morgs_mi.plugins.surface_view import SampledPixels, SurfaceView
from morgs_mi.render.channels import aov_attributes, attribute_widths, exr_names
from morgs_mi.render.kernel_recording import render_lock
from morgs_mi.render.projection import AttachedCamera
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

__all__ = ["GaussianSplatIntegrator"]

_log = logging.getLogger(__name__)

# Settings of the rasteriser that are properties of the plugin.
_SETTINGS = ("eps2d", "alpha_min", "stop_transmittance", "antialiased", "first_order_motion", "reproducible")


class _SceneGaussians:
    """The Gaussians of all shapes, in the scene's order (see `ActivatedGaussians`)."""

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    sh_coeffs: Tensor
    motion: Tensor = None
    confidence: Tensor = None

    def __init__(self, tensors: dict[str, Tensor]) -> None:
        vars(self).update(tensors)

    def rows(self, name: str, index: UInt32) -> list[Float]:
        """Return rows of an attribute, see `ActivatedGaussians`."""
        return tensor_rows(getattr(self, name), index)


def _scene_gaussians(scene: Any, attributes: list[str], with_surfaces: bool) -> _SceneGaussians:
    """Return the Gaussians of all shapes, padded with zeros to the largest number of SH coefficients."""
    shapes = [shape for shape in scene.shapes() if shape.is_ellipsoids()]
    for shape in scene.shapes():
        if not (with_surfaces or shape.is_ellipsoids()):
            raise ValueError(
                f"gaussian_splat: expected `ellipsoids` shapes only, got {shape.class_name()} {shape.id()!r}; "
                "remove it from the scene, or set `surfaces` to an integrator that renders it, such as `path`."
            )
    if not shapes:
        raise ValueError("gaussian_splat: expected a scene with an `ellipsoids` shape, got none; add one.")
    parts = [_shape_gaussians(shape, attributes) for shape in shapes]
    K = max(part["sh_coeffs"].shape[1] for part in parts)
    for part in parts:
        N, present, _ = part["sh_coeffs"].shape
        if present < K:
            part["sh_coeffs"] = dr.concat([part["sh_coeffs"], dr.zeros(mi.TensorXf, (N, K - present, 3))], axis=1)
    if len(parts) == 1:
        return _SceneGaussians(parts[0])
    return _SceneGaussians({name: dr.concat([part[name] for part in parts], axis=0) for name in parts[0]})


def _shape_gaussians(shape: Any, attributes: list[str]) -> dict[str, Tensor]:
    """Return one shape's attributes by the rasteriser's names, attached to the shape's parameters."""
    params: Any = mi.traverse(shape)
    data = mi.TensorXf(params["data"], (dr.width(params["data"]) // 10, 10))
    N = data.shape[0]
    part = {"means": data[:, :3], "scales": data[:, 3:6], "quats": data[:, mi.UInt32(9, 6, 7, 8)]}
    all_widths = attribute_widths()
    for name in attributes:
        widths = all_widths[name]
        size = dr.width(params[name]) if name in params else 0
        if size not in [N * width for width in widths]:
            expected = " or ".join(map(str, widths))
            content = f"{size} values" if name in params else f"only {sorted(params.keys())}"
            raise ValueError(
                f"gaussian_splat: the {shape.class_name()} {shape.id()!r} must have `{name}` [N, {expected}] with "
                f"N={N}, got {content}; set it where the shape is defined."
            )
        tail = (size // N // 3, 3) if name == "sh_coeffs" else BY_ACTIVATED_NAME[name].shape
        part[name] = mi.TensorXf(params[name], (N, *tail))
    return part


def _sensor_camera(sensor: Any, border: int) -> Camera:
    """Return the camera of the sensor's whole film with a margin of `border` pixels."""
    if sensor.class_name() != "PerspectiveCamera":
        raise ValueError(
            f"gaussian_splat: expected a `perspective` sensor, got {sensor.class_name()}; splats are drawn only by "
            "pinhole cameras without lens distortion."
        )
    params: Any = mi.traverse(sensor)
    W, H = (int(size) for size in sensor.film().size())
    names = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
    fov, offset_x, offset_y = (params[name] for name in names)
    f = 0.5 * W / dr.tan(dr.deg2rad(0.5 * fov))
    # Mitsuba adds its offset to the pixel's position: the principal point moves the other way.
    cx, cy = W * (0.5 - offset_x) + border, H * (0.5 - offset_y) + border
    K = np.diag([float(f[0]), float(f[0]), 1.0])
    K[:2, 2] = cx[0], cy[0]
    world_to_sensor = mi.TensorXf(dr.rcp(params["to_world"].matrix))[..., 0]
    # Mitsuba's camera has x to the left and y up.
    viewmat = world_to_sensor * mi.TensorXf([-1, -1, 1, 1], (4, 1))
    size = (W + 2 * border, H + 2 * border)
    near = float(params["near_clip"])
    return AttachedCamera(K, viewmat, *size, sensor.id(), near, intrinsics=(f, f, cx, cy))


def _render_config(props: Any) -> RenderConfig:
    """Return the settings of the rasteriser that the properties give."""
    try:
        return RenderConfig(**{name: props[name] for name in _SETTINGS if name in props})
    except ValueError as error:
        raise ValueError(f"gaussian_splat: {error}") from None


class GaussianSplatIntegrator(mi.CppADIntegrator):
    r"""Gaussian splatting integrator (:monosp:`gaussian_splat`).

    .. pluginparameters::

     * - srgb_primitives
       - |bool|
       - Whether the SH coefficients give sRGB-encoded colours, which reach the film as linear light after
         blending. (Default: True)

     * - background
       - |rgb|
       - Colour behind all Gaussians, encoded like the primitives. (Default: black)

     * - aovs
       - |string|
       - Further channels, a comma-separated list of `motion` (`motion.X`, `motion.Y`: displacement since the
         last frame, px), `depth` (`depth.Y`: expected z, world units) and the channels of attributes such as
         `confidence` (`confidence.Y`). Channels that are not listed are not computed. (Default: none)

     * - eps2d, alpha_min, stop_transmittance
       - |float|
       - Cut-offs of the rasteriser, see `RenderConfig`. (Default: 0.3, 1/255, 1e-4)

     * - antialiased
       - |bool|
       - Whether small splats fade instead of growing, for models that were trained so. (Default: False)

     * - first_order_motion
       - |bool|
       - Whether `motion` is linear in the displacement, as in the MoRGS paper. (Default: False)

     * - reproducible
       - |bool|
       - Whether gradients are summed in a fixed order, at twice the time. (Default: False)

     * - surfaces
       - |integrator|
       - Integrator for the other shapes of the scene, which are blended among the splats. (Default: none, and other
         shapes are refused)

    The film's size, crop, border, reconstruction filter and pixel format are honoured; every pixel gets one
    sample at its centre. Therefore `spp`, the seeds and the sampler have no effect. Emitters (with a warning), the
    sensor's far plane and shutter, and the shapes' `extent` are ignored. A crop saves no time.

    With `surfaces`, that integrator renders the other shapes with `spp` samples; their mean is the pixel's sample.
    A pixel's splats end at the mean depth of the surfaces in it, and are blended twice if they cover it in part.
    Surfaces get no light or shadow from splats, and splats get none from surfaces; see docs/surfaces.md for both.
    The surfaces have no derivatives with respect to the sensor.

    Integrators around it, such as `aov` and `moment`, are refused: they need the colour of single rays.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.srgb_primitives = bool(props.get("srgb_primitives", True))
        self.config = _render_config(props)
        background = props.get("background", None)
        self.background = None if background is None else np.broadcast_to(np.array(background, float), 3).tolist()
        names = (name.strip() for name in props.get("aovs", "").split(","))
        self.aovs = list(dict.fromkeys(name for name in names if name))
        self.surfaces = props.get("surfaces", None)
        if not (self.surfaces is None or isinstance(self.surfaces, mi.Integrator)):
            raise ValueError(
                f"gaussian_splat: `surfaces` must be an integrator, got {self.surfaces!r}; pass one such as "
                "{'type': 'path'}."
            )
        if self.surfaces is not None and not mi.is_rgb:
            raise ValueError(
                f"gaussian_splat: with `surfaces`, expected a variant such as 'llvm_ad_rgb', got {mi.variant()!r}; "
                "call mi.set_variant() before the scene is loaded, because Gaussians have RGB colours."
            )
        self.warned = False
        names = aov_attributes()
        for name in self.aovs:
            if name not in names:
                raise ValueError(
                    f"gaussian_splat: `aovs` must be out of {', '.join(names)}, got {name!r}; separate them by commas."
                )

    def sample(self, *_: Any, **__: Any) -> Any:
        """Refuse to render single rays, as an integrator around this one requests.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "gaussian_splat: expected to be the scene's integrator, got an integrator around it, such as `aov` or "
            "`moment`, which needs the colour of single rays; list further channels in `aovs`, such as 'depth'."
        )

    def aov_names(self) -> list[str]:
        return [channel for name in self.aovs for channel in exr_names(name)]

    def render(
        self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True
    ) -> Any:
        with dr.suspend_grad():
            film, _ = self._expose(scene, sensor, seed, spp)
            image = film.develop() if develop else mi.TensorXf()
        film.schedule_storage()
        if evaluate:
            dr.eval(image)
            dr.sync_thread()
        return image

    def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
        with dr.resume_grad():
            film, surfaces = self._expose(scene, sensor, seed, spp)
            image = film.develop()
            if surfaces is not None:
                surfaces.forward(params)
            with render_lock:
                dr.forward_to(image)
            return dr.grad(image)

    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
    ) -> None:
        with dr.resume_grad():
            film, surfaces = self._expose(scene, sensor, seed, spp)
            image = film.develop()
            dr.set_grad(image, grad_in)
            with render_lock:
                dr.backward_from(image)
            if surfaces is not None:
                surfaces.backward(params)

    def _expose(self, scene: Any, sensor: Any, seed: Any, spp: int) -> tuple[Any, SurfaceView | None]:
        """Render the scene to the sensor's film and return the film, and the surfaces if there are any."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        film = sensor.film()
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            raise ValueError(
                f"gaussian_splat: expected an `hdrfilm`, got {film.class_name()}; replace it, because only RGB is "
                "drawn."
            )
        border = film.rfilter().border_size() if film.sample_border() else 0
        camera = _sensor_camera(sensor, border)
        has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        required = (aov_attributes()[name] for name in self.aovs)
        attributes = ["opacities", "sh_coeffs", *(name for name in required if name)]
        gaussians = _scene_gaussians(scene, attributes, self.surfaces is not None)
        channels = ("color", *(["alpha"] if has_alpha else []), *self.aovs)
        # Cropped after rendering: the projection's linearisation depends on the extent of the whole view.
        (x0, y0), (w, h) = film.crop_offset(), film.crop_size() + 2 * border
        crop = (int(x0), int(y0), int(w), int(h))

        surfaces = None
        if self.surfaces is not None:
            pixels = SampledPixels(camera, crop, sensor, seed, spp)
            surfaces = SurfaceView.of(scene, self.surfaces, pixels, gaussians, self.srgb_primitives, self.config)
        if surfaces is None:
            self._warn_about_emitters(scene)
            columns = self._splats(gaussians, camera, channels, crop)
        else:
            columns = composite(gaussians, channels, self.background, surfaces, self.config)
        values = [*columns["color"], *(columns["alpha"] if has_alpha else [])]
        values += [mi.Float(1)]  # the sample's weight
        values += [value for name in self.aovs for value in columns[name]]

        film.prepare(self.aov_names())
        block, index = film.create_block(), dr.arange(mi.UInt32, w * h)
        block.set_coalesce(False)  # useful for many samples per pixel only
        block.put(mi.Point2f(index % w, index // w) + mi.Point2f(x0, y0) + (0.5 - border), values)
        film.put_block(block)
        return film, surfaces

    def _splats(
        self, gaussians: Any, camera: Camera, channels: tuple[str, ...], crop: tuple[int, int, int, int]
    ) -> dict[str, list[Float]]:
        """Return the channels of a scene without surfaces, colour in linear light."""
        image = rasterize(gaussians, camera, channels, self.background, config=self.config)
        columns = {name: cropped(image[name], crop) for name in channels}
        if self.srgb_primitives:
            columns["color"] = [decode_traced(value) for value in columns["color"]]
        return columns

    def _warn_about_emitters(self, scene: Any) -> None:
        if scene.emitters() and not self.warned:
            _log.warning("gaussian_splat ignores the scene's emitters; set its `background` colour instead.")
            self.warned = True

    def to_string(self) -> str:
        return (
            f"GaussianSplatIntegrator[\n  srgb_primitives = {self.srgb_primitives},\n"
            f"  background = {self.background},\n  aovs = {self.aovs}\n]"
        )

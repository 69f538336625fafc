"""The Mitsuba integrator `gaussian_splat`: a scene's Gaussians through the rasteriser onto its film.

    "integrator": {"type": "gaussian_splat", "aovs": "motion,depth"}

It draws every `ellipsoids` (and `ellipsoidsmesh`) shape of a scene and reads the attributes that Mitsuba's own
`volprim_rf_basic` reads, so one scene file renders with both. N is the number of Gaussians of a shape,
K = (degree + 1)^2:

    data [N, 10]          centre, standard deviations, quaternion xyzw
    opacities [N, 1]      in [0, 1]
    sh_coeffs [N, 3 K]    colour = max(0.5 + SH, 0), coefficient k of colour component j at 3 k + j
    motion [N, 3]         world units per frame; only for the AOV `motion`
    confidence [N, 1]     in [0, 1]; only for the AOV `confidence`

`mi.render(scene, params)` is differentiable, in both modes, in these attributes and in the sensor's `to_world`.

Importing this module registers the plugin with the variant that is set and with every one set later.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians, tensor_rows
from morgs_mi.render.rasterize import rasterize

__all__ = ["ellipsoids"]

_log = logging.getLogger(__name__)

_AOV_NAMES = {"motion": ("motion.X", "motion.Y"), "confidence": ("confidence.Y",), "depth": ("depth.Y",)}
_ATTRIBUTE_WIDTHS = {"opacities": (1,), "sh_coeffs": (3, 12, 27, 48), "motion": (3,), "confidence": (1,)}


def ellipsoids(gaussians: ActivatedGaussians) -> dict[str, Any]:
    """Return the dictionary of the `ellipsoids` shape that holds a copy of N Gaussians' activated attributes.

    The scene's parameters are what is optimised from then on: gradients do not reach `gaussians`.
    """
    names = ("means", "scales", "quats", *_ATTRIBUTE_WIDTHS)
    values = {name: getattr(gaussians, name) for name in names}
    values = {name: np.array(dr.detach(value)) for name, value in values.items() if value is not None}
    means, scales, quats = (values.pop(name) for name in names[:3])
    # Mitsuba takes unit quaternions for granted.
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    data = np.concatenate([means, scales, np.roll(quats, -1, axis=1)], axis=1)
    attributes = {name: mi.TensorXf(value.reshape(len(data), -1)) for name, value in values.items()}
    return {"type": "ellipsoids", "data": mi.TensorXf(data), **attributes}


@dataclass(frozen=True)
class _SceneGaussians:
    """The Gaussians of all shapes, in the scene's order (see `ActivatedGaussians`)."""

    means: Any
    scales: Any
    quats: Any
    opacities: Any
    sh_coeffs: Any
    motion: Any = None
    confidence: Any = None

    def rows(self, name: str, index: Any) -> list[Any]:
        """Return rows of an attribute, see `ActivatedGaussians`."""
        return tensor_rows(getattr(self, name), index)


def _scene_gaussians(scene: Any, attributes: list[str]) -> _SceneGaussians:
    """Gather the Gaussians of all shapes; those with fewer SH coefficients are padded with zeros."""
    shapes = scene.shapes()
    for shape in shapes:
        if not shape.is_ellipsoids():
            raise ValueError(
                f"gaussian_splat: expected `ellipsoids` shapes only, got {shape.class_name()} {shape.id()!r}; "
                "remove it from the scene, or use an integrator that meets surfaces, such as `path`."
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
        return _SceneGaussians(**parts[0])
    return _SceneGaussians(**{name: dr.concat([part[name] for part in parts], axis=0) for name in parts[0]})


def _shape_gaussians(shape: Any, attributes: list[str]) -> dict[str, Any]:
    """Return one shape's attributes under the rasteriser's names, attached to the shape's parameters."""
    params = mi.traverse(shape)
    data = mi.TensorXf(params["data"], (dr.width(params["data"]) // 10, 10))
    N = data.shape[0]
    part = {"means": data[:, :3], "scales": data[:, 3:6], "quats": data[:, mi.UInt32(9, 6, 7, 8)]}
    for name in attributes:
        widths = _ATTRIBUTE_WIDTHS[name]
        size = dr.width(params[name]) if name in params else 0
        if size not in [N * width for width in widths]:
            expected = " or ".join(map(str, widths))
            found = f"{size} values" if name in params else f"only {sorted(params.keys())}"
            raise ValueError(
                f"gaussian_splat: the {shape.class_name()} {shape.id()!r} must carry `{name}` [N, {expected}] with "
                f"N={N}, got {found}; set it where the shape is defined."
            )
        tail = {"sh_coeffs": (size // N // 3, 3), "motion": (3,)}.get(name, ())
        part[name] = mi.TensorXf(params[name], (N, *tail))
    return part


def _sensor_camera(sensor: Any, border: int) -> Camera:
    """Return the sensor's view of its whole film and of `border` pixels around it."""
    if sensor.class_name() != "PerspectiveCamera":
        raise ValueError(
            f"gaussian_splat: expected a `perspective` sensor, got {sensor.class_name()}; splats are drawn by pinhole "
            "cameras without lens distortion only."
        )
    params, (W, H) = mi.traverse(sensor), (int(size) for size in sensor.film().size())
    names = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
    fov, offset_x, offset_y = (float(params[name][0]) for name in names)
    f = 0.5 * W / np.tan(np.deg2rad(0.5 * fov))
    # Mitsuba adds its offset to the pixel's position, so the principal point moves the other way.
    cx, cy = W * (0.5 - offset_x) + border, H * (0.5 - offset_y) + border
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    world_to_sensor = mi.TensorXf(dr.rcp(params["to_world"].matrix))[..., 0]
    # Mitsuba's camera has x to the left and y up.
    viewmat = world_to_sensor * mi.TensorXf([-1, -1, 1, 1], (4, 1))
    return Camera(K, viewmat, W + 2 * border, H + 2 * border, sensor.id(), float(params["near_clip"]))


def _plugin() -> type:
    """Return the integrator class of the active variant; its base class exists once per variant."""

    class GaussianSplatIntegrator(mi.CppADIntegrator):
        r"""Gaussian splatting integrator (:monosp:`gaussian_splat`).

        .. pluginparameters::

         * - srgb_primitives
           - |bool|
           - Whether the SH coefficients give sRGB-encoded colours, which reach the film as linear light after
             blending. (Default: True)

         * - background
           - |rgb|
           - Colour behind everything, encoded as the primitives are. (Default: black)

         * - aovs
           - |string|
           - Further channels, a comma-separated list of `motion` (`motion.X`, `motion.Y`: where each pixel came
             from, px), `confidence` (`confidence.Y`) and `depth` (`depth.Y`: expected z, world units). What is not
             asked for costs nothing. (Default: none)

        The film's size, crop, border, reconstruction filter and pixel format are honoured; every pixel gets one
        sample at its centre, so `spp`, the seeds and the sampler have no effect. It ignores emitters (with a
        warning), the sensor's far plane and shutter, and the shapes' `extent`. A crop saves no time.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            if not dr.is_jit_v(mi.Float) or not dr.is_diff_v(mi.Float):
                raise ValueError(
                    f"gaussian_splat: expected a variant such as 'llvm_ad_rgb' or 'cuda_ad_rgb', got {mi.variant()!r}; "
                    "call mi.set_variant() before the scene is loaded."
                )
            self.srgb_primitives = bool(props.get("srgb_primitives", True))
            background = props.get("background", None)
            self.background = None if background is None else np.broadcast_to(np.array(background, float), 3).tolist()
            names = (name.strip() for name in props.get("aovs", "").split(","))
            self.aovs = list(dict.fromkeys(name for name in names if name))
            self.warned = False
            for name in self.aovs:
                if name not in _AOV_NAMES:
                    raise ValueError(f"gaussian_splat: `aovs` must be out of {', '.join(_AOV_NAMES)}, got {name!r}.")

        def aov_names(self) -> list[str]:
            return [channel for name in self.aovs for channel in _AOV_NAMES[name]]

        def render(
            self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True
        ) -> Any:
            with dr.suspend_grad():
                film = self._expose(scene, sensor)
                image = film.develop() if develop else mi.TensorXf()
            film.schedule_storage()
            if evaluate:
                dr.eval(image)
                dr.sync_thread()
            return image

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            with dr.resume_grad():
                image = self._expose(scene, sensor).develop()
                dr.forward_to(image)
                return dr.grad(image)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            with dr.resume_grad():
                image = self._expose(scene, sensor).develop()
                dr.set_grad(image, grad_in)
                dr.backward_from(image)

        def _expose(self, scene: Any, sensor: Any) -> Any:
            """Draw the scene onto the sensor's film and return the film."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            film = sensor.film()
            if mi.has_flag(film.flags(), mi.FilmFlags.Special):
                raise ValueError(f"gaussian_splat: expected an `hdrfilm`, got {film.class_name()}; only RGB is drawn.")
            if scene.emitters() and not self.warned:
                _log.warning("gaussian_splat ignores the scene's emitters; a `background` colour can be given to it.")
                self.warned = True

            border = film.rfilter().border_size() if film.sample_border() else 0
            has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
            attributes = ["opacities", "sh_coeffs", *(name for name in self.aovs if name != "depth")]
            image = rasterize(
                _scene_gaussians(scene, attributes),
                _sensor_camera(sensor, border),
                ("color", *(["alpha"] if has_alpha else []), *self.aovs),
                self.background,
            )
            # Cut out only now: the projection's linearisation depends on the extent of the whole view.
            (x0, y0), (w, h) = film.crop_offset(), film.crop_size() + 2 * border

            def columns(tensor: Any) -> list[Any]:
                return [tensor[y0 : y0 + h, x0 : x0 + w, i].array for i in range(tensor.shape[2])]

            values = columns(image.color)
            if self.srgb_primitives:
                values = [mi.math.srgb_to_linear(value) for value in values]
            values += columns(image.alpha) if has_alpha else []
            values += [mi.Float(1)]  # the sample's weight
            for name in self.aovs:
                values += columns(getattr(image, name))

            film.prepare(self.aov_names())
            block, index = film.create_block(), dr.arange(mi.UInt32, w * h)
            block.set_coalesce(False)  # worth it for many samples a pixel only
            block.put(mi.Point2f(index % w, index // w) + mi.Point2f(x0, y0) + (0.5 - border), values)
            film.put_block(block)
            return film

        def to_string(self) -> str:
            return (
                f"GaussianSplatIntegrator[\n  srgb_primitives = {self.srgb_primitives},\n"
                f"  background = {self.background},\n  aovs = {self.aovs}\n]"
            )

    return GaussianSplatIntegrator


def _register(*_: Any) -> None:
    """Make the plugin known to the active variant."""
    plugin = _plugin()
    mi.register_integrator("gaussian_splat", lambda props: plugin(props))


mi.detail.add_variant_callback(_register)
if mi.variant() is not None:
    _register()

"""The surfaces of a Mitsuba scene as one camera sees them, rendered by one of Mitsuba's own
integrators.

The scene's shapes other than Gaussians are put into a second scene, which shares the objects:
gradients of a nested integrator such as `prb` reach the parameters of the whole scene.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import ActivatedGaussians
from morgs_mi.core.types import Color3f, Float, Tensor, UInt32, Vector2f
from morgs_mi.platform.checks import require
from morgs_mi.render.render_config import RenderConfig
from morgs_mi.surfaces.splat_rays import SplatRays

_log = logging.getLogger(__name__)
PLACE = "gaussian_splat"
"""Where the errors of the plugin begin."""
# Rays along each axis of a pixel that find its coverage and depth.
_GRID = 3


@dataclass(frozen=True)
class Crop:
    """Pixels of a view, row by row."""

    offset: mi.ScalarPoint2u  #: First pixel (x, y).
    size: mi.ScalarVector2u  #: Width and height.

    @property
    def count(self) -> int:
        """Number of pixels P."""
        return self.size.x * self.size.y

    @property
    def slices(self) -> tuple[slice, slice]:
        """The rows and columns in an image of the view."""
        x, y = self.offset
        width, height = self.size
        return slice(y, y + height), slice(x, x + width)


def rays_for(
    integrator: Any, gaussians: ActivatedGaussians, config: RenderConfig | None = None
) -> SplatRays | None:
    """Return N Gaussians prepared for a `splat_path`; None for other integrators."""
    return SplatRays(gaussians, config) if hasattr(integrator, "splats") else None


@contextmanager
def traced(integrator: Any, splats: SplatRays | None, srgb: bool) -> Iterator[None]:
    """Let an integrator trace rays through Gaussians inside the context.

    Args:
        integrator: any integrator.
        splats: the Gaussians, see `rays_for`; None: the integrator is left as it is.
        srgb: whether their colours are sRGB-encoded.
    """
    if splats is None:
        yield
        return
    integrator.splats = splats
    integrator.srgb = srgb
    try:
        yield
    finally:
        integrator.splats = None


def ellipsoids_of(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes of a scene that are Gaussians."""
    return [shape for shape in scene.shapes() if shape.is_ellipsoids()]


def surface_scene(scene: mi.Scene) -> mi.Scene | None:
    """Return a scene of the surfaces and emitters of `scene`, or None if it has neither surfaces
    nor an environment.

    It shares the shapes, emitters and materials with `scene`, and is built for their current state.

    Raises:
        ValueError: there is no emitter, or a surface has no BSDF or is the boundary of a volume.
    """
    surfaces = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
    if not surfaces and scene.environment() is None:
        return None
    require(
        scene.emitters(),
        PLACE,
        "expected an emitter that lights the surfaces",
        "none",
        "add one to the scene, such as an `envmap` of morgs_mi.light_probe()",
    )
    for shape in surfaces:
        name = f"{shape.class_name()} {shape.id()!r}"
        require(
            not shape.is_medium_transition(),
            PLACE,
            "expected surfaces",
            f"{name}, the boundary of a medium",
            "remove the medium, because splats have no place in the order of a volume's light",
        )
        require(
            shape.bsdf() is not None,
            PLACE,
            f"the {name} must have a BSDF",
            "none",
            "set `bsdf` where the shape is defined",
        )
    return shared_scene([*surfaces, *lights(scene)], scene)


def lights(scene: mi.Scene) -> list[mi.Object]:
    """Return the emitters of a scene, without the emitters on its surfaces."""
    return [
        emitter
        for emitter in scene.emitters()
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
    ]


def shared_scene(parts: list[mi.Object], whole: mi.Scene) -> mi.Scene:
    """Return a scene of some shapes and emitters of a whole scene, which does not change.

    A new scene names its parts, and sets the extent of an environment to its own; both are set
    back.
    """
    names = [part.id() for part in parts]
    scene = mi.load_dict({"type": "scene", **{f"part{i}": part for i, part in enumerate(parts)}})
    for part, name in zip(parts, names, strict=True):
        part.set_id(name)
        if isinstance(part, mi.Emitter):
            part.set_scene(whole)
    return scene


def _attached(thing: mi.Object) -> list[str]:
    """Return the names of the parameters of a scene or shape that are attached to the gradient
    graph.
    """
    params: Any = mi.traverse(thing)
    return [key for key in params.keys() if dr.grad_enabled(params[key])]  # noqa: SIM118


@contextmanager
def _detached(shapes: list[mi.Shape]) -> Iterator[None]:
    """Detach the parameters of shapes inside the context.

    Calls of Mitsuba's virtual functions are traced for all shapes that exist, of any scene. In
    forward mode `prb` would depend on shapes that its scene does not have, and fail.
    """
    tables: list[tuple[mi.Shape, Any]] = [(shape, mi.traverse(shape)) for shape in shapes]
    # Copies: a parameter is a reference to the shape's value.
    attached = [
        (params, key, type(params[key])(params[key]))
        for shape, params in tables
        for key in _attached(shape)
    ]
    for params, key, value in attached:
        params[key] = dr.detach(value)
    try:
        yield
    finally:
        for params, key, value in attached:
            params[key] = value


@dataclass(frozen=True)
class SampledPixels:
    """Pixels of a view, and the samples of an integrator in them."""

    camera: Camera  #: The view.
    crop: Crop  #: Its pixels, P in all.
    template: mi.Sensor  #: Sensor with the sampler and the far plane.
    seed: int = 0  #: Seed of the samples.
    spp: int = 0  #: Samples per pixel; 0: the sampler's number.

    def sensor(self) -> mi.Sensor:
        """Return a sensor with a film of the pixels."""
        params: Any = mi.traverse(self.template)
        more = {"far_clip": float(params["far_clip"]), "sampler": self.template.sampler()}
        film = {
            "crop_offset_x": self.crop.offset.x,
            "crop_offset_y": self.crop.offset.y,
            "crop_width": self.crop.size.x,
            "crop_height": self.crop.size.y,
        }
        return mi.load_dict({**self.camera.sensor(pixel_format="rgba", **film), **more})


@dataclass(frozen=True)
class SurfaceView:
    """Surfaces as seen by one camera, P pixels row by row."""

    scene: mi.Scene  #: The surfaces, see `surface_scene`.
    gaussians: list[mi.Shape]  #: The other shapes.
    integrator: Any  #: Renders them.
    pixels: SampledPixels  #: The pixels and their samples.
    sensor: mi.Sensor  #: The camera, with a film of those pixels.
    #: Radiance and alpha of the nested integrator [h, w, 4], in linear light, a leaf of the
    #: gradient graph.
    image: Tensor
    coverage: Float  #: Fraction of each pixel in which a surface is seen [P], in [0, 1].
    #: Mean camera-space z of what is seen there [P], world units; inf where there is no surface.
    depth: Float
    #: Radiance of the environment at the pixels' centres, `mi.Color3f` [P], a leaf of the gradient
    #: graph; None if there is none, or the integrator hides it.
    behind: Color3f
    #: The Gaussians, for an integrator that traces rays through them; None for other integrators.
    splats: SplatRays | None
    srgb: bool  #: Whether their colours are sRGB-encoded.

    @staticmethod
    def of(
        whole: mi.Scene,
        integrator: Any,
        pixels: SampledPixels,
        splats: ActivatedGaussians,
        srgb: bool,
        config: RenderConfig,
    ) -> SurfaceView | None:
        """Render the surfaces of a scene, or return None if it has neither surfaces nor an
        environment.

        Args:
            whole: scene of Gaussians and surfaces.
            integrator: renders them.
            pixels: pixels that are rendered, and their samples.
            splats: the Gaussians of the scene.
            srgb: whether their colours are sRGB-encoded.
            config: cut-offs of rays through them.

        Raises:
            ValueError: as for `surface_scene`.
        """
        scene = surface_scene(whole)
        if scene is None:
            return None
        gaussians = ellipsoids_of(whole)
        sensor = pixels.sensor()
        rays = rays_for(integrator, splats, config)
        with dr.suspend_grad(), traced(integrator, rays, srgb):
            image = mi.TensorXf(integrator.render(scene, sensor, seed=pixels.seed, spp=pixels.spp))
            if image.shape[2] < 3:
                raise ValueError(
                    f"{PLACE}: `surfaces` must be an integrator of colours, got one of "
                    f"{integrator.aov_names()} alone; put a `path` into it."
                )
            coverage, depth = coverage_and_depth(scene, sensor, pixels.camera, pixels.crop)
            behind = None
            if scene.environment() is not None and not getattr(integrator, "hide_emitters", False):
                behind = _environment(scene, sensor)
        dr.enable_grad(image, behind)
        return SurfaceView(
            scene, gaussians, integrator, pixels, sensor, image, coverage, depth, behind, rays, srgb
        )

    def forward(self, params: Any) -> None:
        """Set the tangents of `image` and `behind`; the surfaces' parameters have theirs."""
        if not self._differentiates():
            return
        with _detached(self.gaussians), traced(self.integrator, self.splats, self.srgb):
            tangent = self.integrator.render_forward(
                self.scene, params, self.sensor, seed=self.pixels.seed, spp=self.pixels.spp
            )
        dr.set_grad(self.image, tangent)
        values = self._attached_environment()
        if values is not None:
            dr.set_grad(self.behind, dr.forward_to(values, flags=dr.ADFlag.ClearEdges))

    def backward(self, params: Any) -> None:
        """Propagate the gradients of `image` and `behind` to the surfaces' parameters, adding to
        their gradients.

        Its samples differ from the samples of `image`: where an image is no linear function of the
        radiance, the product of two noisy factors would be biased.
        """
        if not self._differentiates():
            return
        seed, _ = mi.sample_tea_32(self.pixels.seed, 1)
        grad = dr.grad(self.image)
        with traced(self.integrator, self.splats, self.srgb):
            self.integrator.render_backward(
                self.scene, params, grad, self.sensor, seed=seed, spp=self.pixels.spp
            )
        values = self._attached_environment()
        if values is not None:
            # `values` may be a parameter itself: its gradient is added to.
            dr.backward(dr.sum(dr.dot(values, dr.grad(self.behind))))

    def _attached_environment(self) -> Color3f | None:
        """Return the radiance of the environment that the parameters give; None if there is none,
        or it is not differentiated.
        """
        if self.behind is None:
            return None
        values = _environment(self.scene, self.sensor)
        return values if dr.grad_enabled(values) else None

    def _differentiates(self) -> bool:
        """Return whether any parameter of the surfaces is differentiated."""
        attached = _attached(self.scene)
        params: Any = mi.traverse(self.scene)
        # Mitsuba says it of an environment's image too, behind which nothing is hidden.
        environments = [e.id() for e in self.scene.emitters() if e.is_environment()]
        moving = [
            name
            for name in attached
            if params.flags(name) & mi.ParamFlags.Discontinuous
            and name.partition(".")[0] not in environments
        ]
        if moving:
            _log.warning(
                f"{PLACE}: gradients of the surfaces' positions lack what changes with "
                "their silhouettes and depth; do not optimise `%s` with it.",
                "`, `".join(moving),
            )
        if self.splats is not None and any(map(_attached, self.gaussians)):
            _log.warning(
                "splat_path: gradients of the Gaussians are those of the splats that the camera "
                "sees; they lack what the Gaussians send to the surfaces and take from their "
                "light."
            )
        return bool(attached)


@dr.syntax
def coverage_and_depth(
    scene: Any, sensor: mi.Sensor, camera: Camera, crop: Crop
) -> tuple[Float, Float]:
    """Return the coverage and the mean depth z of surfaces in every pixel [P], by rays through a
    regular grid.

    Args:
        scene: the surfaces.
        sensor: a camera's sensor, with a film of the pixels of `crop`.
        camera: the same camera.
        crop: pixels of the camera's image, P in all.
    """
    coverage = dr.zeros(mi.Float, crop.count)
    depth = dr.full(mi.Float, dr.inf, crop.count)
    box = _rectangle(scene.bbox(), camera, crop)
    if dr.hint(not box.count, mode="scalar"):
        return coverage, depth
    lane: UInt32 = dr.arange(mi.UInt32, box.count)
    columns: UInt32 = dr.opaque(mi.UInt32, box.size.x)
    row = lane // columns
    column = lane - row * columns
    width: UInt32 = dr.opaque(mi.UInt32, crop.size.x)
    pixel = (row + box.offset.y) * width + column + box.offset.x
    params: Any = mi.traverse(sensor)
    to_camera = params["to_world"].inverse()

    k = mi.UInt32(0)
    count = mi.Float(0)
    total = mi.Float(0)
    while dr.hint(k < _GRID**2, label="coverage"):
        rays = _rays(sensor, pixel, (mi.Vector2f(k % _GRID, k // _GRID) + 0.5) / _GRID)
        intersection = scene.ray_intersect_preliminary(rays, coherent=True)
        hit = intersection.is_valid()
        z = (to_camera @ rays(dr.select(hit, intersection.t, 0))).z
        count += dr.select(hit, mi.Float(1), 0)
        total += dr.select(hit, z, 0)
        k += 1
    dr.scatter(coverage, count / _GRID**2, pixel, mode=dr.ReduceMode.Permute)
    dr.scatter(
        depth, dr.select(count > 0, total / count, dr.inf), pixel, mode=dr.ReduceMode.Permute
    )
    dr.eval(coverage, depth)
    return coverage, depth


def _rectangle(box: Any, camera: Camera, crop: Crop) -> Crop:
    """Return the pixels of a crop that a bounding box may reach, counted from the crop's first."""
    if not box.valid():  # no surface
        return Crop(mi.ScalarPoint2u(0), mi.ScalarVector2u(0))
    ends = np.stack([np.ravel(box.min), np.ravel(box.max)])
    pixels, depths = camera.project(np.array(list(product(*ends.T))))
    low = np.zeros(2)
    high = np.array(crop.size)
    if (depths >= camera.near).all():
        ends = np.stack([np.floor(pixels.min(0)) - 1, np.ceil(pixels.max(0)) + 1])
        low, high = np.clip(ends - np.array(crop.offset), 0, high)
    return Crop(mi.ScalarPoint2u(low.astype(int)), mi.ScalarVector2u((high - low).astype(int)))


def _environment(scene: mi.Scene, sensor: mi.Sensor) -> Color3f:
    """Return the radiance of the environment behind every pixel's centre."""
    pixel = dr.arange(mi.UInt32, int(dr.prod(sensor.film().crop_size())))
    rays = _rays(sensor, pixel, mi.Point2f(0.5))
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(pixel))
    si.wi = -rays.d
    si.wavelengths = rays.wavelengths
    return mi.Color3f(mi.unpolarized_spectrum(scene.environment().eval(si)))


def _rays(sensor: Any, pixel: UInt32, offset: Vector2f) -> mi.Ray3f:
    """Return rays through the positions `offset` [0, 1]^2 of pixels of a sensor's film, numbered
    row by row.
    """
    size: Any = dr.opaque(mi.Vector2u, list(sensor.film().crop_size()))
    row = pixel // size.x
    position = (mi.Vector2f(pixel - row * size.x, row) + offset) / mi.Vector2f(size)
    return sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))[0]

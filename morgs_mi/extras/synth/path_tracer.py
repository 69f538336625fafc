"""A moving scene in Mitsuba: images and visible surface points at a given time."""

from __future__ import annotations

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.capture.lens import Lens, undistorted
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import encode_light
from morgs_mi.core.rig import in_image
from morgs_mi.core.types import SceneDict
from morgs_mi.extras.synth.ground_truth import SurfacePoints
from morgs_mi.extras.synth.scene import Pose, Scene
from morgs_mi.platform.checks import require

# A hit within this share of a point's distance is its own surface: intersections are
# single-precision.
_OWN_SURFACE = 1e-4


def developed(linear: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """Return exposed light [H, W, 3] as an image, sRGB-encoded [H, W, 3], uint8.

    Mitsuba's bitmap conversion is not used because it dithers, and dither looks like noise in a
    static scene.

    Args:
        linear: the light; 1 is white.
        noise: standard deviation of the sensor noise per channel, relative to white. It does not
            depend on the brightness: photon noise grows with the square root of the light, which
            the sRGB encoding approximates.
        seed: seed of the noise.
    """
    grain = noise * np.random.default_rng([seed, 1]).standard_normal(linear.shape) if noise else 0.0
    values = encode_light(np.clip(linear, 0, 1))
    return np.rint(255 * np.clip(values + grain, 0, 1)).astype(np.uint8)


def _pixel_corners(width: int, rows: np.ndarray) -> np.ndarray:
    """Return the upper left corners of the pixels of some rows of an image [R W, 2]."""
    return np.stack(np.meshgrid(np.arange(width), rows), axis=-1).reshape(-1, 2)


def _rays(kind: Any, origin: np.ndarray, directions: np.ndarray) -> Any:
    """Return rays of a Mitsuba type from one point [3] in several directions [P, 3]."""
    # An array, because a literal would compile a separate kernel for every camera.
    origins = np.repeat(origin[:, None], len(directions), axis=1)
    return kind(mi.Point3f(origins), mi.Vector3f(directions.T))


class PathTracer:
    """Path tracer of a scene at one time.

    The scene is loaded once. Only the transforms of instances change, so all views and frames run
    the same kernels.
    """

    def __init__(self, scene: Scene) -> None:
        """Load the scene into Mitsuba.

        Raises:
            ValueError: Mitsuba cannot load it.
        """
        self.scene = scene
        content: SceneDict = {"type": "scene"}
        for name, light in scene.lights.items():
            content |= light.entries(name)
        owners: dict[str, int] = {}  # the index of the object of each shape
        for index, (name, item) in enumerate(scene.objects.items()):
            entries = item.entries(name)
            content |= entries
            owners |= dict.fromkeys(entries, index)
        try:
            # The optimisation would merge meshes that share a material, even meshes of different
            # objects.
            self._scene: Any = mi.load_dict(content, optimize=False)
        except RuntimeError as error:
            # Mitsuba's message begins with a line of its own source.
            reason = re.sub(r"^\[\w+\.cpp:\d+\] ", "", str(error)).rstrip(".! ")
            raise ValueError(
                f"scene {scene.name!r}: Mitsuba cannot load it: {reason}; correct the dictionary."
            ) from error
        shapes = [shape for shape in self._scene.shapes() if shape.id() in owners]
        self._owners = [(mi.ShapePtr(shape), owners[shape.id()]) for shape in shapes]
        self._params: Any = mi.traverse(self._scene)
        # Pose and transform of the lamps that have a pose, by parameter of the scene.
        self._lamps: dict[str, tuple[Pose, np.ndarray]] = {}
        for name, light in scene.lights.items():
            if light.pose is not None:
                key = f"{name}.to_world"
                require(
                    key in self._params,
                    f"scene {scene.name!r}, light {name!r}",
                    "a lamp with a pose must be a shape with an emitter, e.g. a rectangle",
                    light.shape["type"],
                    "use one, or leave out the pose",
                )
                transform = np.array(self._params[key].matrix, float).reshape(4, 4)
                self._lamps[key] = (light.pose, transform)
        self._exposure = 1.0
        # Only lamps are sampled: 16 samples have as little noise as 64 samples with a sky, and are
        # seven times faster.
        self._integrator: Any = mi.load_dict(
            {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
        )
        self.set_time(0.0)

    @property
    def has_emitters(self) -> bool:
        """Whether the scene has an emitter."""
        return bool(self._scene.emitters())

    def poses(self, time: float) -> np.ndarray:
        """Return the poses of the objects [O, 4, 4], by their ids, at `time` in seconds."""
        return np.stack(
            [
                np.eye(4) if item.pose is None else item.pose(time)
                for item in self.scene.objects.values()
            ]
        )

    def set_time(self, time: float) -> None:
        """Set the poses of all objects and lamps, and the exposure, to `time` in seconds."""
        for name, item in self.scene.objects.items():
            if item.pose is not None:
                self._params[f"{name}.to_world"] = mi.Transform4f(item.pose(time))
        for name, (pose, transform) in self._lamps.items():
            self._params[name] = mi.Transform4f(pose(time) @ transform)
        self._params.update()
        self._exposure = self.scene.exposure(time)

    def render(self, camera: Camera, spp: int, seed: int, noise: float = 0.0) -> np.ndarray:
        """Return the path-traced view, sRGB-encoded [H, W, 3], uint8.

        Args:
            camera: the view.
            spp: samples per pixel.
            seed: seed of the samples and the noise.
            noise: standard deviation of the sensor noise per channel, as for `developed`.
        """
        return developed(self.light(camera, spp, seed), noise, seed)

    def light(self, camera: Camera, spp: int, seed: int) -> np.ndarray:
        """Return the exposed light of a view, linear [H, W, 3]."""
        sampler = {"type": "multijitter", "sample_count": spp}
        sensor = mi.load_dict({**camera.sensor(), "sampler": sampler})
        render: Any = mi.render  # annotated with Dr.Jit's types, called with Python's
        linear = render(self._scene, sensor=sensor, integrator=self._integrator, spp=spp, seed=seed)
        return self._exposure * np.array(linear)[..., :3]

    def light_of_rows(
        self, camera: Camera, rows: np.ndarray, spp: int, seed: int, lens: Lens
    ) -> np.ndarray:
        """Return the exposed light of some rows of an image that a lens has distorted, linear
        [R, W, 3].

        Args:
            camera: the view without distortion.
            rows: indices of the rows [R].
            spp: samples per pixel.
            seed: seed of the samples.
            lens: the distortion.
        """
        # All samples of the pixels at once.
        sampler: Any = mi.load_dict({"type": "multijitter", "sample_count": spp})
        spp = sampler.sample_count()  # rounded up by the sampler
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, len(rows) * camera.width * spp)
        # The samples of a pixel follow one another.
        corners = _pixel_corners(camera.width, rows)
        pixels = corners[:, None] + np.array(sampler.next_2d()).T.reshape(len(corners), -1, 2)
        origin, directions = camera.rays(undistorted(camera, lens, pixels.reshape(-1, 2)))
        ray = _rays(mi.RayDifferential3f, origin, directions)
        light = np.array(self._integrator.sample(self._scene, sampler, ray, None, mi.Bool(True))[0])
        return self._exposure * light.T.reshape(len(rows), camera.width, -1, 3).mean(axis=2)

    def surface_points(self, camera: Camera) -> SurfacePoints:
        """Return the surface points at the pixel centres [H, W]."""
        pixels = _pixel_corners(camera.width, np.arange(camera.height)) + 0.5
        position, directions = camera.rays(pixels)
        hit: Any = self._scene.ray_intersect(_rays(mi.Ray3f, position, directions))
        dr.eval(hit)  # otherwise every array below would trace the rays again
        ids = np.full(dr.width(hit.p), -1, np.int32)
        for pointer, index in self._owners:
            ids[np.array((hit.shape == pointer) | (hit.instance == pointer))] = index
        points = SurfacePoints(np.array(hit.p, float).T.copy(), ids)
        return points.reshaped(camera.height, camera.width)

    def sees(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return the mask of the surface points [P, 3] that a camera sees: inside its image, with
        nothing in front.
        """
        offset = points - camera.position
        distance = np.linalg.norm(offset, axis=-1)
        ray = _rays(mi.Ray3f, camera.position, offset / distance[:, None])
        ray.maxt = mi.Float((1 - _OWN_SURFACE) * distance)
        is_free = ~np.array(self._scene.ray_test(ray))
        pixels, depth = camera.project(points)
        return is_free & (depth > camera.near) & in_image(camera, pixels)

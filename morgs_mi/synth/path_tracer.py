"""A moving scene set up in Mitsuba: set the time, take pictures, ask which surface a pixel sees."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.synth.scene import Scene

__all__ = ["PathTracer", "srgb_bytes"]


def srgb_bytes(linear: np.ndarray, noise: np.ndarray | float = 0.0) -> np.ndarray:
    """Return linear light [...] in [0, 1] as sRGB (IEC 61966-2-1) plus `noise`, clipped and rounded to uint8.

    Mitsuba's bitmap conversion would dither, which is noise that a static scene does not have.
    """
    linear = np.clip(linear, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255 * np.clip(encoded + noise, 0, 1)).astype(np.uint8)


class PathTracer:
    """The scene at one instant.

    It is loaded once; moving objects are instances whose transforms alone change, so that all views and
    frames run the same kernels.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        content = {"type": "scene", **{name: light.shape for name, light in scene.lights.items()}}
        owners: dict[str, int] = {}
        for index, (name, thing) in enumerate(scene.objects.items()):
            if thing.pose is None:
                parts = {f"{name}_{part}": shape for part, shape in thing.shapes.items()}
            else:
                content[f"{name}_group"] = {"type": "shapegroup", **thing.shapes}
                parts = {name: {"type": "instance", "group": {"type": "ref", "id": f"{name}_group"}}}
            content |= parts
            owners |= dict.fromkeys(parts, index)
        # Optimising would merge meshes that share a material, and with them the objects they belong to.
        self._scene = mi.load_dict(content, optimize=False)
        self._owners = [(mi.ShapePtr(s), owners[s.id()]) for s in self._scene.shapes() if s.id() in owners]
        self._params = mi.traverse(self._scene)
        swung = {name: light.pose for name, light in scene.lights.items() if light.pose is not None}
        self._lamps = {f"{name}.to_world": (pose, self._own(name)) for name, pose in swung.items()}
        self._exposure = 1.0
        # Lamps alone are sampled: 16 samples are as clean as 64 with a sky, which takes seven times longer.
        self._integrator = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0})
        self.move(0.0)

    def _own(self, light: str) -> np.ndarray:
        """Return where a lamp's shape puts it in the lamp's own space [4, 4]."""
        return np.array(self._params[f"{light}.to_world"].matrix, float).reshape(4, 4)

    def poses(self, time: float) -> list[np.ndarray]:
        """Return each object's pose [4, 4] at `time` in seconds."""
        return [np.eye(4) if thing.pose is None else thing.pose(time) for thing in self.scene.objects.values()]

    def move(self, time: float) -> None:
        """Put every object and lamp where it is at `time` in seconds, and expose as at that time."""
        for name, thing in self.scene.objects.items():
            if thing.pose is not None:
                self._params[f"{name}.to_world"] = mi.Transform4f(thing.pose(time))
        for name, (pose, own) in self._lamps.items():
            self._params[name] = mi.Transform4f(pose(time) @ own)
        self._params.update()
        self._exposure = 1.0 if self.scene.exposure is None else self.scene.exposure(time)

    def picture(self, camera: Camera, spp: int, seed: int, noise: float = 0.0) -> np.ndarray:
        """Path-trace the view; return it sRGB-encoded [H, W, 3], uint8.

        Args:
            camera: the view.
            spp: samples per pixel.
            seed: of the samples and the noise.
            noise: standard deviation of the sensor's noise per channel, where white is 1. It is the same in the dark
                and in the light, for the noise of photons grows with the root of their number and sRGB is nearly one.
        """
        sampler = {"type": "multijitter", "sample_count": spp}
        sensor = mi.load_dict({**camera.sensor(), "sampler": sampler})
        linear = mi.render(self._scene, sensor=sensor, integrator=self._integrator, spp=spp, seed=seed)
        linear = self._exposure * np.array(linear)[..., :3]
        grain = noise * np.random.default_rng([seed, 1]).standard_normal(linear.shape) if noise else 0.0
        return srgb_bytes(linear, grain)

    def surface(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the surface points [H, W, 3] that the pixel centres see, and their objects' ids [H, W].

        The id is -1, and the point meaningless, where the pixel sees nothing or a lamp.
        """
        y, x = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
        rays = np.linalg.solve(camera.K, np.stack([x, y, np.ones_like(x)]))
        rays = np.asarray(camera.viewmat)[:3, :3].T @ (rays / np.linalg.norm(rays, axis=0))
        origins = np.repeat(camera.position[:, None], rays.shape[1], axis=1)
        hit = self._scene.ray_intersect(mi.Ray3f(mi.Point3f(origins), mi.Vector3f(rays)))
        ids = np.full(rays.shape[1], -1, np.int32)
        for pointer, index in self._owners:
            ids[np.array((hit.shape == pointer) | (hit.instance == pointer))] = index
        shape = camera.height, camera.width
        return np.array(hit.p, float).T.reshape(*shape, 3), ids.reshape(shape)

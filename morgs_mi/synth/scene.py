"""Descriptions of moving scenes: rigid objects with a pose at each time, lights, and a rig of cameras.

A scene is a Python file with a function ``build(seed: int) -> Scene``. Poses are functions of the time in
seconds, so a clip may have any frame rate and length. World space has y up; lengths are world units.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.core.camera import Camera

__all__ = ["Light", "Object", "Recording", "Rig", "Scene", "load_scene", "rotate", "translate"]

Pose = Callable[[float], np.ndarray]


@dataclass(frozen=True)
class Object:
    """A rigid object.

    Attributes:
        shapes: Mitsuba shape dictionaries by name, in object space.
        pose: seconds -> rigid object-to-world matrix [4, 4]; None for a static object, whose space is the world's.
    """

    shapes: Mapping[str, dict[str, Any]]
    pose: Pose | None = None


@dataclass(frozen=True)
class Light:
    """A lamp. It has no id in the ground truth, so it must not be visible.

    Attributes:
        shape: Mitsuba dictionary of an emitter, or of a shape with one, in the lamp's space.
        pose: seconds -> rigid lamp-to-world matrix [4, 4]; None for a static lamp, whose space is the world's.
    """

    shape: dict[str, Any]
    pose: Pose | None = None


@dataclass(frozen=True)
class Rig:
    """Fixed cameras on a spherical cap in front of the scene, all looking at its centre.

    Attributes:
        center: point that the cameras look at [3].
        distance: from the cameras to the centre, world units.
        fov: horizontal field of view, degrees.
        elevation: of the cap's centre above the horizon, degrees.
        spread: half-width and half-height of the cap, degrees.
    """

    center: tuple[float, float, float] = (0.0, 0.8, 0.0)
    distance: float = 4.2
    fov: float = 42.0
    elevation: float = 16.0
    spread: tuple[float, float] = (26.0, 10.0)

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """Return `count` cameras: ``cam00`` at the centre of the cap, the others evenly distributed around it."""
        # A sunflower spiral covers the cap evenly for any count.
        radius = np.sqrt(np.arange(count) / max(count - 1, 1))
        angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
        azimuth = np.deg2rad(self.spread[0] * radius * np.cos(angle))
        polar = np.deg2rad(self.elevation + self.spread[1] * radius * np.sin(angle))
        outward = np.stack([np.sin(azimuth) * np.cos(polar), np.sin(polar), np.cos(azimuth) * np.cos(polar)], axis=1)
        origins = np.asarray(self.center) + self.distance * outward
        return [
            Camera.look_at(origin, self.center, (0, 1, 0), self.fov, width, height, f"cam{i:02d}")
            for i, origin in enumerate(origins)
        ]


@dataclass(frozen=True)
class Recording:
    """How a scene is recorded unless `synthesize` is given other values.

    Attributes:
        num_cameras: including the held-out view.
        spp: samples per pixel.
        noise: standard deviation of the sensor noise, relative to white.
    """

    num_cameras: int = 10
    spp: int = 16
    noise: float = 0.0


@dataclass(frozen=True)
class Scene:
    """A moving scene.

    Attributes:
        name: the scene's name in the capture.
        objects: by name; an object's index in this mapping is its id in the ground truth.
        lights: lamps by name.
        rig: positions of the cameras.
        exposure: seconds -> exposure factor of all cameras; None for 1.
        recording: number of cameras and noise.
    """

    name: str
    objects: Mapping[str, Object]
    lights: Mapping[str, Light]
    rig: Rig = field(default_factory=Rig)
    exposure: Callable[[float], float] | None = None
    recording: Recording = field(default_factory=Recording)


def load_scene(scene: str | Path, seed: int = 0) -> Scene:
    """Build the scene of a Python file, given by its path or by its name in ``scenes/``.

    Raises:
        ValueError: there is no such scene, or its file has no ``build``.
    """
    known = _scene_files()
    path = Path(scene) if Path(scene).suffix == ".py" else known.get(str(scene))
    if path is None or not path.is_file():
        raise ValueError(
            f"load_scene(): no scene {str(scene)!r}; name one of {sorted(known)} or pass the path of a .py file."
        )
    spec = importlib.util.spec_from_file_location(f"morgs_mi_scene_{path.stem}", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not hasattr(module, "build"):
        raise ValueError(f"load_scene(): {path} must define `build(seed) -> Scene`; add that function.")
    return module.build(seed)


def translate(x: float, y: float, z: float) -> np.ndarray:
    """Return the translation by (x, y, z) as a matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def rotate(axis: str, angle: float) -> np.ndarray:
    """Return the rotation about the ``x``, ``y`` or ``z`` axis by `angle` in radians as a matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    return matrix


def _scene_files() -> dict[str, Path]:
    """Return the package's scenes: from the repository, or from the data files that pip installed."""
    checkout = Path(__file__).parents[2] / "scenes"
    if checkout.is_dir():
        return {path.stem: path for path in checkout.glob("*.py")}
    installed = metadata.files("morgs-mi") or []
    return {Path(f).stem: Path(str(f.locate())) for f in installed if f.match("morgs_mi/scenes/*.py")}

"""Descriptions of moving scenes: rigid objects with a pose per instant, lights, and a rig of cameras.

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

__all__ = ["Light", "Object", "Rig", "Scene", "load_scene", "rotate", "translate"]

Pose = Callable[[float], np.ndarray]


@dataclass(frozen=True)
class Object:
    """A rigid object.

    Attributes:
        shapes: Mitsuba shape dictionaries by name, placed in the object's own space.
        pose: seconds -> rigid object-to-world matrix [4, 4]; None for what never moves, whose own space
            is the world.
    """

    shapes: Mapping[str, dict[str, Any]]
    pose: Pose | None = None


@dataclass(frozen=True)
class Light:
    """A lamp. It has no id in the ground truth: keep it out of view.

    Attributes:
        shape: Mitsuba dictionary of an emitter, or of a shape that carries one, placed in the lamp's own space.
        pose: seconds -> rigid lamp-to-world matrix [4, 4]; None for what never moves, whose own space is the world.
    """

    shape: dict[str, Any]
    pose: Pose | None = None


@dataclass(frozen=True)
class Rig:
    """Fixed cameras on a cap of a sphere in front of the scene, all looking at its centre.

    Attributes:
        center: where the cameras look [3].
        distance: from the cameras to the centre, world units.
        fov: field of view across the image, degrees.
        elevation: of the cap's middle above the horizon, degrees.
        spread: half-width and half-height of the cap, degrees.
    """

    center: tuple[float, float, float] = (0.0, 0.8, 0.0)
    distance: float = 4.2
    fov: float = 42.0
    elevation: float = 16.0
    spread: tuple[float, float] = (26.0, 10.0)

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """Return `count` cameras: ``cam00`` in the middle of the cap, the others spread evenly about it."""
        # A sunflower fills the cap evenly for any count.
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
class Scene:
    """A moving scene.

    Attributes:
        name: what the capture calls it.
        objects: by name; an object's position in this mapping is its id in the ground truth.
        lights: lamps by name.
        rig: where the cameras stand.
        exposure: seconds -> factor on the light that every camera receives; None for 1.
    """

    name: str
    objects: Mapping[str, Object]
    lights: Mapping[str, Light]
    rig: Rig = field(default_factory=Rig)
    exposure: Callable[[float], float] | None = None


def load_scene(scene: str | Path, seed: int = 0) -> Scene:
    """Build the scene of a Python file, given by its path or by the name of one in ``scenes/``.

    Raises:
        ValueError: if there is no such scene, or its file has no ``build``.
    """
    known = _scene_files()
    path = Path(scene) if Path(scene).suffix == ".py" else known.get(str(scene))
    if path is None or not path.is_file():
        raise ValueError(
            f"load_scene(): no scene {str(scene)!r}; name one of {sorted(known)} or give the path of a .py file."
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
    """Return the scenes that come with the package: beside a checkout, or where pip put its data files."""
    checkout = Path(__file__).parents[2] / "scenes"
    if checkout.is_dir():
        return {path.stem: path for path in checkout.glob("*.py")}
    installed = metadata.files("morgs-mi") or []
    return {Path(f).stem: Path(str(f.locate())) for f in installed if f.match("morgs_mi/scenes/*.py")}

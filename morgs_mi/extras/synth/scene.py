"""Descriptions of moving scenes: rigid objects with a pose at each time, lights and a rig.

A scene is a Python file with a function ``build(seed: int) -> Scene``. Poses are functions of the
time in seconds, so a clip may have any frame rate and length. World space has y up; lengths are
world units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.core.camera import Camera, rigid
from morgs_mi.core.types import SceneDict
from morgs_mi.io.scene_file import build_of, failures_in
from morgs_mi.platform.checks import check_type, require
from morgs_mi.platform.documentation import page

Pose = Callable[[float], np.ndarray]


@dataclass(frozen=True)
class Object:
    """A rigid object."""

    shapes: Mapping[str, SceneDict]  #: Mitsuba shape dictionaries by name, in object space.
    #: Seconds -> rigid object-to-world matrix [4, 4]; None for a static object, in world space.
    pose: Pose | None = None

    def entries(self, name: str) -> SceneDict:
        """Return its entries in a Mitsuba scene by their ids; one that moves is an instance of a
        group.
        """
        if self.pose is None:
            return {f"{name}_{part}": shape for part, shape in self.shapes.items()}
        group = f"{name}_group"
        return {
            group: {"type": "shapegroup", **self.shapes},
            name: {"type": "instance", "group": {"type": "ref", "id": group}},
        }


@dataclass(frozen=True)
class Light:
    """A lamp. It has no id in the ground truth, so it must not be visible."""

    #: Mitsuba dictionary of an emitter, or of a shape with one, in the lamp's space.
    shape: SceneDict
    #: Seconds -> rigid lamp-to-world matrix [4, 4]; None for a static lamp, in world space.
    pose: Pose | None = None

    def entries(self, name: str) -> SceneDict:
        """Return its entry in a Mitsuba scene by its id."""
        return {name: self.shape}


@dataclass(frozen=True)
class Rig:
    """Fixed cameras on a spherical cap in front of the scene, all looking at its centre."""

    center: tuple[float, float, float] = (0.0, 0.8, 0.0)  #: Point that the cameras look at [3].
    distance: float = 4.2  #: Distance of the cameras from the centre, world units.
    fov: float = 42.0  #: Horizontal field of view, degrees.
    elevation: float = 16.0  #: Elevation of the cap's centre above the horizon, degrees.
    spread: tuple[float, float] = (26.0, 10.0)  #: Half-width and half-height of the cap, degrees.

    def cameras(self, count: int, width: int, height: int) -> list[Camera]:
        """Return `count` cameras: ``cam00`` at the centre of the cap, the others evenly distributed
        around it.
        """
        # A sunflower spiral covers the cap evenly for any count.
        radius = np.sqrt(np.arange(count) / max(count - 1, 1))
        angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
        azimuth = np.deg2rad(self.spread[0] * radius * np.cos(angle))
        polar = np.deg2rad(self.elevation + self.spread[1] * radius * np.sin(angle))
        outward = np.stack(
            [np.sin(azimuth) * np.cos(polar), np.sin(polar), np.cos(azimuth) * np.cos(polar)],
            axis=1,
        )
        origins = np.asarray(self.center) + self.distance * outward
        return [
            Camera.look_at(origin, self.center, (0, 1, 0), self.fov, width, height, f"cam{i:02d}")
            for i, origin in enumerate(origins)
        ]


@dataclass(frozen=True)
class RecordingDefaults:
    """Default settings of a scene's recording, for `synthesize`."""

    num_cameras: int = 10  #: Number of cameras, including the held-out view.
    spp: int = 16  #: Samples per pixel.
    noise: float = 0.0  #: Standard deviation of the sensor noise, relative to white.


def constant_exposure(time: float) -> float:
    """Return the exposure factor 1 at every time."""
    return 1.0


@dataclass(frozen=True)
class Scene:
    """A moving scene."""

    name: str  #: The scene's name in the capture.
    #: Objects by name; the index in this mapping is the id in the ground truth.
    objects: Mapping[str, Object]
    lights: Mapping[str, Light]  #: Lamps by name.
    rig: Rig = field(default_factory=Rig)  #: Positions of the cameras.
    #: Seconds -> exposure factor of all cameras.
    exposure: Callable[[float], float] = constant_exposure
    #: Number of cameras and noise.
    recording: RecordingDefaults = field(default_factory=RecordingDefaults)


def load_scene(scene: str | Path, seed: int = 0) -> Scene:
    """Build the scene of a Python file, given by its path or by its name in ``scenes/``.

    Raises:
        ValueError: there is no such scene, its file has no ``build(seed) -> Scene``, or running the
            file fails; the message names the file and its line.
    """
    # The package's scenes, from the repository or from the installed data files.
    checkout = Path(__file__).parents[3] / "scenes"
    if checkout.is_dir():
        paths = checkout.glob("*.py")
    else:
        installed = metadata.files("morgs-mi") or []
        paths = (Path(str(f.locate())) for f in installed if f.match("morgs_mi/scenes/*.py"))
    files = {path.stem: path for path in paths}
    path = files.get(str(scene), Path(scene))
    require(
        path.suffix == ".py" and path.is_file(),
        "load_scene()",
        "expected a scene",
        repr(str(scene)),
        f"name one of {sorted(files)}, or a .py file",
    )
    build = build_of(path, "build(seed) -> Scene")
    with failures_in(path):
        result = build(seed)
    check_type("load_scene()", f"build(seed) of {path}", result, Scene, "return Scene(...)")
    return result


def check_scene(scene: Scene, times: Sequence[float]) -> None:
    """Check what Mitsuba would not refuse in a scene, and its poses at `times` in seconds.

    Raises:
        ValueError: an object, a lamp or a pose is not as described, or a name is used twice.
    """
    names: set[str] = set()
    for kind, expected, items in (
        ("object", Object, scene.objects),
        ("light", Light, scene.lights),
    ):
        for name, item in items.items():
            where = f"scene {scene.name!r}, {kind} {name!r}"
            check_type(where, "it", item, expected, f"see {page('scenes')}")
            entries = item.entries(name)
            _check_values(where, entries)
            twice = sorted(names & entries.keys())
            require(
                not twice,
                where,
                "its names in Mitsuba must be its own",
                f"{twice} twice",
                "rename one",
            )
            names |= entries.keys()
            if item.pose is not None:
                _check_pose(f"{where}: its pose", item.pose, times)


def _check_pose(place: str, pose: Pose, times: Sequence[float]) -> None:
    """Raise `ValueError` if a pose fails, or is not rigid, at one of some times in seconds."""
    for time in times:
        at = f"{place} at {time:.4g} s"
        try:
            matrix = np.reshape(pose(time), (4, 4))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".rstrip(".")
            raise ValueError(f"{at} fails with {reason}; correct the function.") from error
        rigid(f"{at} is not rigid", matrix)


def _check_values(where: str, node: Mapping[str, Any]) -> None:
    """Raise `ValueError` if a Mitsuba dictionary contains None, which would end the process."""
    for key, value in node.items():
        require(value is not None, where, f"`{key}` must have a value", "None", "leave it out")
        if isinstance(value, Mapping):
            _check_values(f"{where}, {key}", value)


def translate(x: float, y: float, z: float) -> np.ndarray:
    """Return the translation by (x, y, z) as a matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def rotate(axis: str, angle: float) -> np.ndarray:
    """Return the rotation about the ``x``, ``y`` or ``z`` axis by `angle` in radians as a matrix
    [4, 4].
    """
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    return matrix

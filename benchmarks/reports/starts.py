"""Fits without points of scenes that cameras surround: held-out views by the start.

    python -m benchmarks.reports.starts --json out.json

Mitsuba traces the scenes, and `fit_gaussians` gets the images with their sensors alone. The start
"each view" gives it random points in every view, at 0.33 to 3 times the depth of the focus point.
"random" starts from random points at the depths at which most views agree. So does "found", except
on `room` and `hall`, where few cameras are far apart. Settings of this start were chosen on walk4
and `room`, all others on `ring` and `dome`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, StudyOptions
from morgs_mi import Camera, StreamConfig, fit_gaussians, rasterize
from morgs_mi.core.color_space import byte_values, encode_light
from morgs_mi.core.rig import Focus
from morgs_mi.core.view import View
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.initialise import seed_points

COLUMNS = (
    Column("held out, dB", "psnr"),
    Column("training views, dB", "train_psnr"),
)
STARTS = ("each view", "found")
# Points of the former start, of which a fit takes as many as it needs.
_POINTS = 10_000
_SAMPLES = 64
_FOV = 40
_WIDE = (160, 120)
_WHITE = {"type": "constant", "radiance": 0.8}
_LAMP = {"type": "point", "position": [2, 5, 3], "intensity": {"type": "rgb", "value": 40}}


@dataclass(frozen=True)
class Options(StudyOptions):
    """Scenes and output."""

    scenes: tuple[str, ...] = ("ring", "dome", "eight", "floor", "half dome", "room", "hall")
    """Names of the scenes."""
    starts: tuple[str, ...] = STARTS
    """Starts that are compared."""

    def study(self) -> Study:
        """Return the study of the scenes from each start."""
        scenes = rigs()
        cells = product(self.scenes, self.starts)
        return Study(
            measure,
            [
                Scene({"scene": name, "start": start}, (scenes[name], start))
                for name, start in cells
            ],
            seeds=self.fit_seeds,
        )

    def table(self, rows: Sequence[Row]) -> str:
        """Return the scores of each scene from each start."""
        return scores_table(rows, {"scene": "scene", "start": "start"}, COLUMNS)


@dataclass(frozen=True)
class Rig:
    """A scene and the sensors around it.

    Attributes:
        objects: entries of Mitsuba's scene.
        eyes: positions of the sensors, which look at the origin.
        held_out: indices of the sensors that are scored.
        size: width and height of the images, px.
    """

    objects: dict[str, Any]
    eyes: Sequence[Sequence[float]]
    held_out: Sequence[int]
    size: tuple[int, int]


def circle(count: int, height: float, distance: float, share: float = 1.0) -> list[list[float]]:
    """Return positions on a circle, or on a share of it."""
    angles = 2 * np.pi * share * np.arange(count) / (count if share == 1 else count - 1)
    return [[distance * np.sin(a), height, distance * np.cos(a)] for a in angles]


def diffuse(*color: float) -> dict[str, Any]:
    """Return a plain surface."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}}


def checkered(a: Sequence[float], b: Sequence[float], scale: float) -> dict[str, Any]:
    """Return a surface with `scale` checks along each axis."""
    to_uv = mi.ScalarTransform4f().scale([scale, scale, 1])
    colors = {f"color{k}": {"type": "rgb", "value": list(c)} for k, c in enumerate((a, b))}
    return {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": to_uv, **colors}}


def shape(kind: str, center: Sequence[float], size: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return a shape of Mitsuba's, turned and moved."""
    turn = 0 if kind == "sphere" else 35
    place = mi.ScalarTransform4f().translate(list(center)).rotate([1, 1, 0], turn).scale(size)
    return {"type": kind, "to_world": place, "bsdf": bsdf}


def floor(bsdf: dict[str, Any], size: float) -> dict[str, Any]:
    """Return a square below the origin."""
    place = mi.ScalarTransform4f().translate([0, -0.6, 0]).rotate([1, 0, 0], -90).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def room(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return walls and a ceiling far around the origin, and a lamp under it."""
    place = mi.ScalarTransform4f().translate([0, 1.4, 0]).scale([6, 2.2, 6])
    lamp = {**_LAMP, "position": [0.5, 3, 0.8], "intensity": {"type": "rgb", "value": 25}}
    walls = {"type": "cube", "to_world": place, "bsdf": {"type": "twosided", "bsdf": bsdf}}
    return {"walls": walls, "lamp": lamp}


def rigs() -> dict[str, Rig]:
    """Return the scenes by name."""
    red = diffuse(0.9, 0.2, 0.2)
    green = diffuse(0.2, 0.8, 0.3)
    blue = diffuse(0.2, 0.3, 0.9)
    balls = {
        f"ball{k}": {"type": "sphere", "center": center, "radius": 0.45, "bsdf": bsdf}
        for k, (center, bsdf) in enumerate(
            [([-0.6, 0, 0], red), ([0.6, 0.1, 0.2], green), ([0, -0.3, -0.5], blue)]
        )
    }
    checks = checkered((0.9, 0.8, 0.1), (0.1, 0.2, 0.5), 6)
    tiles = checkered((0.7, 0.6, 0.5), (0.2, 0.3, 0.2), 16)
    boxes = {
        "cube": shape("cube", [-0.5, 0, 0.2], 0.35, checks),
        "ball": shape("sphere", [0.5, 0.1, -0.3], 0.35, red),
    }
    things = {
        "cube": shape("cube", [0.5, -0.1, 0.3], 0.3, green),
        "disk": shape("disk", [-0.6, 0.2, -0.2], 0.5, checks),
        "ball": shape("sphere", [-0.1, -0.2, 0.6], 0.35, blue),
    }
    tower = {
        f"cube{k}": shape("cube", [0.5 * k - 0.7, 0.4 * k - 0.5, 0.3 * (k % 2)], 0.25, bsdf)
        for k, bsdf in enumerate((red, checks, green, blue))
    }
    hall = [[*eye[:2], 0.8 * eye[2]] for eye in circle(4, 0.6, 4.0)]
    two_rows = circle(9, 1.0, 4.0) + circle(7, 3.0, 2.8)
    return {
        "ring": Rig(balls | {"light": _WHITE}, circle(12, 1.2, 4.0), [0], (96, 72)),
        "dome": Rig(
            boxes | {"floor": floor(tiles, 3.0), "light": _WHITE}, two_rows, [0, 10], (128, 96)
        ),
        "eight": Rig(things | {"light": _WHITE}, circle(8, 1.2, 4.0), [0], (160, 120)),
        "floor": Rig(
            things | {"floor": floor(checks, 2.0), "light": _WHITE, "lamp": _LAMP},
            circle(7, 0.8, 4.5) + circle(9, 2.4, 3.8),
            [2, 9],
            (160, 120),
        ),
        "half dome": Rig(
            tower | {"light": _WHITE, "lamp": _LAMP},
            circle(7, 0.8, 3.6, 0.5) + circle(5, 2.4, 2.8, 0.5),
            [3, 9],
            (160, 120),
        ),
        # Cameras 72 and 90 degrees apart.
        "room": Rig(
            things | {"floor": floor(checks, 5.0), **room(tiles)}, circle(5, 0.9, 3.5), [2], _WIDE
        ),
        "hall": Rig(tower | {"floor": floor(tiles, 5.0), **room(checks)}, hall, [1], _WIDE),
    }


def traced(rig: Rig) -> tuple[list[Any], list[np.ndarray]]:
    """Return the sensors of a rig and their images in linear light."""
    film = {"type": "hdrfilm", "width": rig.size[0], "height": rig.size[1]}
    film["rfilter"] = {"type": "box"}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, **rig.objects})
    poses = [mi.ScalarTransform4f().look_at(eye, [0, 0, 0], [0, 1, 0]) for eye in rig.eyes]
    sensors = [
        mi.load_dict({"type": "perspective", "fov": _FOV, "to_world": pose, "film": film})
        for pose in poses
    ]
    images = [
        np.asarray(mi.render(scene, sensor=sensor, spp=_SAMPLES))[..., :3] for sensor in sensors
    ]
    return sensors, images


def measure(rig: Rig, start: str, config: StreamConfig) -> dict[str, Any]:
    """Fit the images of a rig and return the scores of its views."""
    sensors, lights = traced(rig)
    images = [byte_values(encode_light(light)) for light in lights]
    cameras = [Camera.of(sensor) for sensor in sensors]
    train = [view for view in range(len(sensors)) if view not in rig.held_out]
    points = ()
    rng = np.random.default_rng(config.seed)
    if start == "each view":
        points = former_points([cameras[v] for v in train], [images[v] for v in train], rng)
    if start == "random":
        points = seed_points([View(cameras[v], images[v]) for v in train], _POINTS, rng)
    fitted = fit_gaussians(
        [sensors[v] for v in train], [images[v] for v in train], *points, config=config
    )

    def mean_psnr(views: Sequence[int]) -> float:
        colors = [
            np.asarray(rasterize(fitted.gaussians, cameras[v], config=fitted.render).color)
            for v in views
        ]
        scores = [
            psnr(np.clip(color, 0, 1), images[v] / 255.0)
            for color, v in zip(colors, views, strict=True)
        ]
        return float(np.mean(scores))

    return {
        "psnr": mean_psnr(rig.held_out),
        "train_psnr": mean_psnr(train),
        "num_gaussians": len(fitted.gaussians),
        "background": fitted.background,
    }


def former_points(
    cameras: Sequence[Camera], images: Sequence[np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return random points in every view, and their colours."""
    points = []
    colors = []
    focus = Focus.of(cameras)
    for camera, image in zip(cameras, images, strict=True):
        pixels = rng.uniform(0, camera.size, (_POINTS // len(cameras), 2))
        columns, rows = pixels.astype(int).T
        depths = focus.depth(camera) / rng.uniform(1 / 3, 3, len(pixels))
        points.append(camera.unproject(pixels, depths))
        colors.append(image[rows, columns] / 255)
    return np.concatenate(points), np.concatenate(colors)


if __name__ == "__main__":
    tyro.cli(Options).run()

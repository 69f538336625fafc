"""Fits without points of scenes that cameras surround: held-out views by the start.

    python -m benchmarks.reports.starts --json out.json

Mitsuba traces the scenes, and `fit_gaussians` gets the images with their sensors alone. The start
"each view" gives it random points in every view, at 0.33 to 3 times the depth of the focus point.
"random" starts from random points at the depths at which most views agree. So does "found", except
on `room`, `hall` and the random rooms, where few cameras are far apart. Settings of this start were
chosen on walk4 and `room`, all others on `ring` and `dome`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.study import Row, Scene, Study, StudyOptions
from morgs_mi import Camera, StreamConfig, fit_gaussians, rasterize
from morgs_mi.core.color_space import byte_values, encode_light
from morgs_mi.core.rig import Focus
from morgs_mi.core.view import View, Views
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.initialise import seed_points

COLUMNS = (
    Column("held out, dB", "psnr"),
    Column("person, dB", "psnr_person"),
    Column("training views, dB", "train_psnr"),
)
STARTS = ("each view", "found")
# Points of the former start, of which a fit takes as many as it needs.
_POINTS = 10_000
_SAMPLES = 64
_FOV = 40
_WIDE = (160, 120)
_TALL = (160, 208)
_WHITE = {"type": "constant", "radiance": 0.8}
_LAMP = {"type": "point", "position": [2, 5, 3], "intensity": {"type": "rgb", "value": 40}}


@dataclass(frozen=True)
class Options(StudyOptions):
    """Scenes and output."""

    scenes: tuple[str, ...] = ("ring", "dome", "eight", "floor", "half dome", "room", "hall")
    """Names of the scenes; "room 3" is a random room of seed 3."""
    starts: tuple[str, ...] = STARTS
    """Starts that are compared."""

    def study(self) -> Study:
        """Return the study of the scenes from each start."""
        scenes = rigs()
        cells = product(self.scenes, self.starts)
        return Study(
            measure,
            [
                Scene(
                    {"scene": name, "start": start},
                    (scenes[name] if name in scenes else random_room(name), start),
                )
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
        person: names of the objects that are a person.
    """

    objects: dict[str, Any]
    eyes: Sequence[Sequence[float]]
    held_out: Sequence[int]
    size: tuple[int, int]
    person: Sequence[str] = ()


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


def random_room(name: str) -> Rig:
    """Return a person between boxes in a room, with four cameras 55 to 95 degrees apart.

    Args:
        name: whose last word is the seed.
    """
    rng = np.random.default_rng(int(name.split()[-1]))

    def surface(checks: int) -> dict[str, Any]:
        a, b = rng.uniform(0.1, 0.9, (2, 3)).tolist()
        return checkered(a, b, checks)

    turn = mi.ScalarTransform4f().rotate([0, 1, 0], rng.uniform(0, 360))
    parts = {
        "legs": turn.translate([0, -0.3, 0]).scale([0.14, 0.3, 0.1]),
        "body": turn.translate([0, 0.25, 0]).scale([0.2, 0.27, 0.12]),
        "arms": turn.translate([0, 0.38, 0]).scale([0.45, 0.05, 0.06]),
    }
    person: dict[str, Any] = {
        part: {"type": "cube", "to_world": place, "bsdf": surface(3)}
        for part, place in parts.items()
    }
    person["head"] = shape("sphere", [0, 0.66, 0], 0.13, diffuse(*rng.uniform(0.2, 0.9, 3)))
    boxes = {
        f"box{k}": shape("cube", [np.sin(angle), -0.4, np.cos(angle)], 0.2, surface(2))
        for k, angle in enumerate(rng.uniform(0, 2 * np.pi, 3))
    }
    angles = np.cumsum(np.radians(rng.uniform(55, 95, 4)))
    eyes = [[3.2 * np.sin(a), rng.uniform(0.3, 1.2), 3.2 * np.cos(a)] for a in angles]
    objects = person | boxes | {"floor": floor(surface(12), 5.0), **room(surface(6))}
    return Rig(objects, eyes, [1], _TALL, (*person,))


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


@dataclass(frozen=True, eq=False)
class TracedView(View):
    """A view of a rig, and its pixels [H, W] that show the person."""

    person: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))


def traced(rig: Rig) -> Views[TracedView]:
    """Return the views of a rig with their images in sRGB."""
    film = {"type": "hdrfilm", "width": rig.size[0], "height": rig.size[1]}
    film["rfilter"] = {"type": "box"}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, **rig.objects})
    shapes = mi.load_dict({"type": "aov", "aovs": "shape:shape_index"})
    # The plugin `aov` numbers shapes by their place in Mitsuba's registry, not in the scene.
    bodies = [mi.ShapePtr(body) for body in scene.shapes() if body.id() in rig.person]
    person = [mi.UInt32(dr.reinterpret_array(mi.UInt32, body))[0] for body in bodies]
    views = []
    for index, eye in enumerate(rig.eyes):
        pose = mi.ScalarTransform4f().look_at(eye, [0, 0, 0], [0, 1, 0])
        sensor = mi.load_dict({"type": "perspective", "fov": _FOV, "to_world": pose, "film": film})
        light = np.asarray(mi.render(scene, sensor=sensor, spp=_SAMPLES))[..., :3]
        shown = np.asarray(mi.render(scene, sensor=sensor, integrator=shapes, spp=1))[..., 0]
        image = byte_values(encode_light(light))
        held_out = index in rig.held_out
        views.append(TracedView(Camera.of(sensor), image, None, held_out, np.isin(shown, person)))
    return Views(views)


def measure(rig: Rig, start: str, config: StreamConfig) -> dict[str, Any]:
    """Fit the images of a rig and return the scores of its views."""
    views = traced(rig)
    rng = np.random.default_rng(config.seed)
    points = ()
    if start == "each view":
        points = former_points(views.train, rng)
    if start == "random":
        points = seed_points(views.train, _POINTS, rng)
    images = [view.image for view in views.train]
    fitted = fit_gaussians(views.train, images, *points, config=config)

    def mean_psnr(views: Sequence[TracedView], *, is_of_person: bool = False) -> float:
        scores = []
        for view in views:
            color = np.asarray(rasterize(fitted.gaussians, view.camera, config=fitted.render).color)
            mask = view.person if is_of_person else None
            scores.append(psnr(np.clip(color, 0, 1), view.image / 255.0, mask))
        return float(np.mean(scores))

    return {
        "psnr": mean_psnr(views.test),
        **({"psnr_person": mean_psnr(views.test, is_of_person=True)} if rig.person else {}),
        "train_psnr": mean_psnr(views.train),
        "num_gaussians": len(fitted.gaussians),
        "background": fitted.background,
    }


def former_points(views: Sequence[View], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return random points in every view, and their colours."""
    points = []
    colors = []
    focus = Focus.of([view.camera for view in views])
    for view in views:
        pixels = rng.uniform(0, view.camera.size, (_POINTS // len(views), 2))
        columns, rows = pixels.astype(int).T
        depths = focus.depth(view.camera) / rng.uniform(1 / 3, 3, len(pixels))
        points.append(view.camera.unproject(pixels, depths))
        colors.append(view.image[rows, columns] / 255)
    return np.concatenate(points), np.concatenate(colors)


if __name__ == "__main__":
    tyro.cli(Options).run()

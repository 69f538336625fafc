"""A random scene for each seed, with its own rig and noise: it tests methods that are tuned to the
other scenes.

The seed draws the objects, their motion, textures, lights, the rig and the noise. `draw_scene`
draws everything but the colours, without Mitsuba; `build` adds walls, textures and lights. Objects
never touch one another: their swept boxes are disjoint. The speed of an object is the speed of its
fastest point in the held-out view, in pixels per frame at 320x240 and 30 frames per second.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi import Camera
from morgs_mi.extras.synth.scene import (
    Light,
    Object,
    RecordingDefaults,
    Rig,
    Scene,
    rotate,
    translate,
)
from morgs_mi.extras.synth.shapes import ball, box, disk, rod
from morgs_mi.extras.synth.textures import lights, pattern, room, textured

WIDTH = 320
HEIGHT = 240
FPS = 30.0
MOTIONS = ("slide", "spin", "swing", "bounce")
SPEEDS = (2.0, 12.0)
THIN_SPEEDS = (7.0, 12.0)
ROOM_HEIGHT = 3.2
ROOM_DEPTH = 1.7
FRONT = 2.0
GAP = 0.04
# Period of all paths in the phase, radians.
PHASES = np.linspace(0, 4 * np.pi, 129)
# Faster oscillations would turn back within a few frames, and faster spins alias.
MAX_RATE = 7.0

Y, Z = np.eye(3)[1:]
# Phases [...] -> poses [..., 4, 4].
Path = Callable[[Any], np.ndarray]
# Mitsuba's dictionaries by name.
Shapes = dict[str, dict[str, Any]]
# A texture's aspect ratio -> its material.
Paint = Callable[[float], dict[str, Any]]


@dataclass(frozen=True)
class Solid:
    """A rigid shape in its own space.

    Attributes:
        kind: the shape's name.
        points: centres of spheres that enclose it [P, 3], world units.
        margin: radius of the spheres.
        parts: returns Mitsuba shapes by name, given a function from a texture's aspect ratio to a
            material.
    """

    kind: str
    points: np.ndarray
    margin: float
    parts: Callable[[Paint], Shapes]


@dataclass(frozen=True)
class Body:
    """A solid with its position and motion.

    Attributes:
        solid: its shape.
        motion: one of `MOTIONS`, or ``static``.
        speed: speed of the fastest point in the held-out view, px per frame; 0 if static.
        pose: seconds -> object-to-world matrix [4, 4].
        bounds: lowest and highest corner of the box that it sweeps [2, 3], world units.
    """

    solid: Solid
    motion: str
    speed: float
    pose: Callable[[float], np.ndarray]
    bounds: np.ndarray


@dataclass(frozen=True)
class RandomScene:
    """Objects, rig and noise of a random scene, without its colours.

    Attributes:
        bodies: bodies by name.
        rig: positions of the cameras.
        recording: number of cameras and noise.
        half_width: half the width of the room, world units.
        swing: amplitude of the lamp's motion about the vertical axis, radians; 0 for a static lamp.
    """

    bodies: dict[str, Body]
    rig: Rig
    recording: RecordingDefaults
    half_width: float
    swing: float


def build(seed: int = 0) -> Scene:
    """Return the scene of a seed."""
    random_scene = draw_scene(seed)
    rng = np.random.default_rng([seed, 1])
    walls = {
        name: Object({part: {**shape, "bsdf": _wall(rng)} for part, shape in wall.shapes.items()})
        for name, wall in room(seed, random_scene.half_width, ROOM_HEIGHT, ROOM_DEPTH).items()
    }
    objects = {name: _object(body, rng) for name, body in random_scene.bodies.items()}
    return Scene(
        "random",
        walls | objects,
        _lights(rng, random_scene.swing),
        random_scene.rig,
        recording=random_scene.recording,
    )


def draw_scene(seed: int) -> RandomScene:
    """Return the objects, rig and noise of a seed's scene."""
    rng = np.random.default_rng([seed, 0])
    noise = rng.uniform(0.003, 0.02) if rng.random() < 0.6 else 0.0
    recording = RecordingDefaults(int(rng.integers(4, 17)), int(rng.choice([4, 16, 49])), noise)
    swing = rng.uniform(0.15, 0.5) if rng.random() < 0.5 else 0.0
    half_width = rng.uniform(2.4, 3.0)
    rig = _rig(rng, half_width)
    cameras = rig.cameras(recording.num_cameras, WIDTH, HEIGHT)
    bodies: dict[str, Body] = {}

    def fits(bounds: np.ndarray) -> bool:
        free = _inside(bounds, half_width) and not any(
            _touch(bounds, body.bounds) for body in bodies.values()
        )
        return free and _seen(bounds, cameras)

    pace = _log_uniform(rng, 3.0, 10.0)
    kinds = rng.permutation(MOTIONS)
    kinds_of_bodies = [(str(kinds[k % len(kinds)]), False) for k in range(rng.integers(2, 6))]
    if rng.random() < 0.6:
        kinds_of_bodies[0] = kinds_of_bodies[0][0], True
    kinds_of_bodies += [("static", bool(rng.random() < 0.25)) for _ in range(rng.integers(1, 6))]
    for motion, thin in kinds_of_bodies:
        body = _place(rng, motion, thin, pace, cameras[0], fits)
        if body is not None:
            bodies[f"{body.motion}_{body.solid.kind}_{len(bodies)}"] = body
    return RandomScene(bodies, rig, recording, half_width, swing)


def _rig(rng: np.random.Generator, half_width: float) -> Rig:
    distance = rng.uniform(3.9, 4.8)
    view = rng.uniform(1.45, 1.75)
    elevation = rng.uniform(11, 26)
    # All cameras are in front of the open side of the room.
    widest = np.rad2deg(np.arcsin(0.85 * half_width / distance))
    return Rig(
        center=(rng.uniform(-0.15, 0.15), rng.uniform(0.7, 0.95), rng.uniform(-0.2, 0.1)),
        distance=distance,
        fov=float(np.rad2deg(2 * np.arctan(view / distance))),
        elevation=elevation,
        spread=(rng.uniform(14, min(widest, 36)), rng.uniform(4, min(12, elevation - 6))),
    )


def _place(
    rng: np.random.Generator,
    motion: str,
    thin: bool,
    pace: float,
    camera: Camera,
    fits: Callable[[np.ndarray], bool],
) -> Body | None:
    """Return a body with bounds that fit, or None if the room is full.

    Args:
        rng: generator of all draws.
        motion: one of `MOTIONS`, or ``static``.
        thin: whether it is a rod, which is fast if it moves.
        pace: mean speed of the other moving objects, px per frame.
        camera: the held-out view, for the speed.
        fits: whether a box [2, 3] is free.
    """
    for _ in range(300):
        solid = _draw_solid(rng, motion == "swing", thin)
        path, floats = _path(rng, motion, solid)
        swept = _sweep(solid, path)
        clearance = rng.uniform(0.05, 1.0) if floats else 0.0
        place = translate(rng.uniform(-1.5, 1.5), clearance - swept[0, 1], rng.uniform(-1.4, 1.1))
        bounds = swept + place[:3, 3]
        if not fits(bounds):
            continue
        if motion == "static":
            return Body(solid, motion, 0.0, _pose(place, path, 0.0, 0.0), bounds)
        speed = (
            rng.uniform(*THIN_SPEEDS)
            if thin
            else float(np.clip(pace * _log_uniform(rng, 0.7, 1.4), *SPEEDS))
        )
        rate = speed * FPS / _peak(camera, solid, place, path)
        if rate <= MAX_RATE:
            return Body(
                solid, motion, speed, _pose(place, path, rng.uniform(-0.9, 0.1), rate), bounds
            )
    return None


def _draw_solid(rng: np.random.Generator, hangs: bool, thin: bool) -> Solid:
    """Return a solid that stands or floats, or one that hangs from the origin; a rod if `thin`."""
    if thin:
        return _rod(rng, hangs)
    if hangs:
        return _pendulum(rng)
    return (_ball, _box, _plate, _column, _dumbbell, _cross)[rng.integers(6)](rng)


def _ball(rng: np.random.Generator) -> Solid:
    radius = rng.uniform(0.15, 0.36)
    return Solid("ball", np.zeros((1, 3)), radius, lambda paint: {"ball": ball(radius, paint(1))})


def _box(rng: np.random.Generator) -> Solid:
    half = rng.uniform(0.11, 0.34, 3)
    return _block("box", half)


def _plate(rng: np.random.Generator) -> Solid:
    half = np.array([rng.uniform(0.2, 0.4), rng.uniform(0.2, 0.45), rng.uniform(0.015, 0.04)])
    return _block("plate", half)


def _block(kind: str, half: np.ndarray) -> Solid:
    return Solid(
        kind, _corners(half), 0.0, lambda paint: {kind: box((0, 0, 0), half.tolist(), paint(1))}
    )


def _column(rng: np.random.Generator) -> Solid:
    radius = rng.uniform(0.09, 0.26)
    half = rng.uniform(0.15, 0.5)

    def parts(paint: Paint) -> Shapes:
        side = paint(half / (np.pi * radius))
        end = paint(1)
        ends = {
            name: disk((0, y, 0), radius, end) for name, y in (("top", half), ("bottom", -half))
        }
        return {"side": rod((0, -half, 0), (0, half, 0), radius, side), **ends}

    return Solid("column", _corners(np.array([radius, half, radius])), 0.0, parts)


def _dumbbell(rng: np.random.Generator) -> Solid:
    half = rng.uniform(0.22, 0.42)
    return _bar("dumbbell", -half, half, rng.uniform(0.03, 0.06), rng.uniform(0.10, 0.20))


def _cross(rng: np.random.Generator) -> Solid:
    half = rng.uniform(0.25, 0.42)
    thickness = rng.uniform(0.04, 0.09)
    beams = {
        "x": (half, thickness, thickness),
        "y": (thickness, half, thickness),
        "z": (thickness, thickness, half),
    }

    def parts(paint: Paint) -> Shapes:
        return {axis: box((0, 0, 0), beam, paint(1)) for axis, beam in beams.items()}

    points = np.concatenate([_corners(np.array(beam)) for beam in beams.values()])
    return Solid("cross", points, 0.0, parts)


def _rod(rng: np.random.Generator, hangs: bool) -> Solid:
    length = rng.uniform(0.6, 1.1)
    radius = rng.uniform(0.018, 0.035)
    high = 0.0 if hangs else 0.5 * length
    return _bar("rod", high - length, high, radius, radius)


def _bar(kind: str, low: float, high: float, radius: float, knob: float) -> Solid:
    """Return an upright bar with a ball at either end."""

    def parts(paint: Paint) -> Shapes:
        ends = {
            name: ball(knob, paint(1), (0, y, 0)) for name, y in (("bottom", low), ("top", high))
        }
        return {
            "bar": rod(
                (0, low, 0), (0, high, 0), radius, paint((high - low) / (2 * np.pi * radius))
            ),
            **ends,
        }

    return Solid(kind, np.array([[0, low, 0], [0, high, 0]]), knob, parts)


def _pendulum(rng: np.random.Generator) -> Solid:
    length = rng.uniform(0.5, 1.0)
    string = rng.uniform(0.015, 0.03)
    half = (
        rng.uniform(0.10, 0.24) * np.ones(3) if rng.random() < 0.5 else rng.uniform(0.08, 0.22, 3)
    )
    round_bob = half[0] == half[1]

    def parts(paint: Paint) -> Shapes:
        bob = (
            ball(half[0], paint(1), (0, -length, 0))
            if round_bob
            else box((0, -length, 0), half.tolist(), paint(1))
        )
        return {
            "string": rod((0, 0, 0), (0, -length, 0), string, paint(length / (2 * np.pi * string))),
            "bob": bob,
        }

    points = np.concatenate([np.zeros((1, 3)), _corners(half) - [0, length, 0]])
    return Solid("pendulum", points, string, parts)


def _corners(half: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(*zip(-half, half, strict=True)), axis=-1).reshape(-1, 3)


def _path(rng: np.random.Generator, motion: str, solid: Solid) -> tuple[Path, bool]:
    """Return poses by phase in radians, and whether the object need not stand on the floor."""
    upright = rotate("y", rng.uniform(-np.pi, np.pi))
    free = solid.kind in ("rod", "dumbbell", "cross") and motion != "static"
    attitude = upright @ rotate("z", rng.uniform(-0.6, 0.6)) if free else upright
    heading = rng.uniform(-0.6, 0.6)
    direction = np.array([np.cos(heading), 0, np.sin(heading)]) * rng.choice([-1, 1])
    reach = rng.uniform(0.2, 0.6)
    if motion == "static":
        return lambda s: np.broadcast_to(attitude, (*np.shape(s), 4, 4)), False
    if motion == "slide":
        # A ball rolls; others turn a little.
        turn = (
            np.cross(Y, direction) / solid.margin
            if solid.kind == "ball"
            else rng.uniform(-1, 1) * Y
        )

        def slide(s: Any) -> np.ndarray:
            way = reach * np.sin(s)
            return (
                _rigid(np.multiply.outer(way, direction), np.multiply.outer(way, turn)) @ attitude
            )

        return slide, free
    if motion == "spin":
        tilted = free or solid.kind == "ball"
        axis = rotate("y", heading) @ rotate("x", rng.uniform(-0.4, 0.4)) if tilted else np.eye(4)
        return lambda s: axis @ _rigid(0, np.multiply.outer(s, Z if free else Y)), free
    if motion == "swing":
        plane = rotate("y", heading)
        turn = rng.uniform(0.35, 0.75) * Z
        return lambda s: plane @ _rigid(0, np.multiply.outer(np.sin(s), turn)), True
    up = rng.uniform(0.2, 0.6) * Y
    drift = rng.uniform(0, 0.4) * direction
    tumble = rng.uniform(-1, 1, 3) if solid.kind == "ball" else np.zeros(3)

    def bounce(s: Any) -> np.ndarray:
        parabola = 1 - (2 * (s / np.pi % 1) - 1) ** 2
        shift = np.multiply.outer(parabola, up) + np.multiply.outer(np.sin(0.5 * s), drift)
        return _rigid(shift, np.multiply.outer(np.sin(0.5 * s), tumble)) @ attitude

    return bounce, False


def _pose(
    place: np.ndarray, path: Path, start: float, rate: float
) -> Callable[[float], np.ndarray]:
    return lambda time: place @ path(start + rate * time)


def _sweep(solid: Solid, path: Path) -> np.ndarray:
    """Return the corners [2, 3] of the box that a solid sweeps."""
    points = _move(path(PHASES), solid.points)
    return np.stack(
        [points.min(axis=(0, 1)) - solid.margin, points.max(axis=(0, 1)) + solid.margin]
    )


def _peak(camera: Camera, solid: Solid, place: np.ndarray, path: Path) -> float:
    """Return the speed of a solid's fastest surface point in a view, pixels per radian."""
    around = solid.margin * np.concatenate([np.eye(3), -np.eye(3)])
    surface = (solid.points[:, None] + around).reshape(-1, 3)
    pixels = camera.project(_move(place @ path(PHASES), surface))[0]
    return float(np.linalg.norm(np.diff(pixels, axis=0), axis=-1).max() / (PHASES[1] - PHASES[0]))


def _inside(bounds: np.ndarray, half_width: float) -> bool:
    """Return whether a box stands on or above the floor, away from the walls."""
    lowest = [GAP - half_width, -1e-9, GAP - ROOM_DEPTH]
    highest = [half_width - GAP, ROOM_HEIGHT - GAP, FRONT]
    return bool((bounds[0] >= lowest).all() and (bounds[1] <= highest).all())


def _seen(bounds: np.ndarray, cameras: list[Camera]) -> bool:
    """Return whether the held-out camera, and at least three quarters of all cameras, see a box."""
    corners = np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(-1, 3)
    pixels = np.stack([camera.project(corners)[0] for camera in cameras])
    mask: np.ndarray = np.all((pixels > 0) & (pixels < [WIDTH, HEIGHT]), axis=(1, 2))
    return bool(mask[0] and mask.mean() >= 0.75)


def _touch(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((a[0] < b[1] + GAP).all() and (b[0] < a[1] + GAP).all())


def _move(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points [P, 3] at poses [S, 4, 4], as [S, P, 3]."""
    return points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def _rigid(shift: np.ndarray | float, turn: np.ndarray) -> np.ndarray:
    """Return rotations about the vectors `turn` [..., 3] by their lengths in radians, then shifts,
    as [..., 4, 4].
    """
    matrix = np.broadcast_to(np.eye(4), (*turn.shape[:-1], 4, 4)).copy()
    matrix[..., :3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[..., :3, 3] = shift
    return matrix


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _object(body: Body, rng: np.random.Generator) -> Object:
    """Return a body with textures; the shapes of a static one, which has no pose, are placed in the
    world.
    """
    import mitsuba as mi

    texture = _texture(rng, (2, 4, 8), (4, 24))
    roughness = (
        rng.uniform(0.2, 0.4)
        if body.solid.kind in ("ball", "box") and rng.random() < 0.25
        else None
    )
    shapes = body.solid.parts(
        lambda aspect: textured(texture, roughness, (1, max(1, round(aspect))))
    )
    if body.motion != "static":
        return Object(shapes, body.pose)
    to_world = mi.ScalarTransform4f(body.pose(0))
    world_shapes = {
        name: {**shape, "to_world": to_world @ shape.get("to_world", mi.ScalarTransform4f())}
        for name, shape in shapes.items()
    }
    return Object(world_shapes)


def _wall(rng: np.random.Generator) -> dict[str, Any]:
    return textured(_texture(rng, (4, 8, 10, 16), (8, 60)))


def _texture(
    rng: np.random.Generator, cells: tuple[int, ...], finest: tuple[float, float]
) -> np.ndarray:
    """Return a reflectance texture: fine or smooth, with or without a checker, of strong or weak
    contrast.
    """
    hue = rng.random()
    first = _color(rng, hue)
    second = first if rng.random() < 0.4 else _color(rng, hue + rng.normal(0, 0.2))
    seed = int(rng.integers(2**31))
    texture = pattern(seed, first, second, int(rng.choice(cells)), _log_uniform(rng, *finest))
    mean = texture.mean(axis=(0, 1))
    return mean + np.float32(rng.uniform(0.3, 1)) * (texture - mean)


def _color(rng: np.random.Generator, hue: float) -> tuple[float, float, float]:
    return colorsys.hsv_to_rgb(hue % 1, rng.uniform(0.1, 0.75), rng.uniform(0.25, 0.7))


def _lights(rng: np.random.Generator, swing: float) -> dict[str, Light]:
    """Return the lamps of `textures.lights`, turned about the vertical axis, with other strengths
    and tints.
    """
    side = rng.uniform(-1.2, 0.4)
    rate = rng.uniform(2, 5)
    phase = rng.uniform(-0.9, 0.1)
    poses = {"lamp": lambda t: rotate("y", side + swing * np.sin(phase + rate * t)), "fill": None}
    strength = {"lamp": rng.uniform(0.75, 1.1), "fill": rng.uniform(0.5, 1.4)}

    def relit(name: str, light: Light) -> Light:
        emitter = light.shape["emitter"]
        tint = strength[name] * rng.uniform(0.9, 1.1, 3)
        radiance = {"type": "rgb", "value": [float(v) for v in tint * emitter["radiance"]["value"]]}
        return Light({**light.shape, "emitter": {**emitter, "radiance": radiance}}, poses[name])

    return {name: relit(name, light) for name, light in lights().items()}

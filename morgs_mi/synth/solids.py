"""Solids of random size, for the random scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from morgs_mi.synth.shapes import ball, box, disk, rod

__all__ = ["Paint", "Solid", "draw_solid"]

Shapes = dict[str, dict[str, Any]]
Paint = Callable[[float], dict[str, Any]]


@dataclass(frozen=True)
class Solid:
    """A rigid shape in its own space.

    Attributes:
        kind: the shape's name.
        points: centres of spheres that enclose it [P, 3], world units.
        margin: radius of the spheres.
        parts: returns Mitsuba shapes by name, given a function from a texture's aspect ratio to a material.
    """

    kind: str
    points: np.ndarray
    margin: float
    parts: Callable[[Paint], Shapes]


def draw_solid(rng: np.random.Generator, hangs: bool, thin: bool) -> Solid:
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
    return Solid(kind, _corners(half), 0.0, lambda paint: {kind: box((0, 0, 0), half.tolist(), paint(1))})


def _column(rng: np.random.Generator) -> Solid:
    radius, half = rng.uniform(0.09, 0.26), rng.uniform(0.15, 0.5)

    def parts(paint: Paint) -> Shapes:
        side, end = paint(half / (np.pi * radius)), paint(1)
        ends = {name: disk((0, y, 0), radius, end) for name, y in (("top", half), ("bottom", -half))}
        return {"side": rod((0, -half, 0), (0, half, 0), radius, side), **ends}

    return Solid("column", _corners(np.array([radius, half, radius])), 0.0, parts)


def _dumbbell(rng: np.random.Generator) -> Solid:
    half = rng.uniform(0.22, 0.42)
    return _bar("dumbbell", -half, half, rng.uniform(0.03, 0.06), rng.uniform(0.10, 0.20))


def _cross(rng: np.random.Generator) -> Solid:
    half, thickness = rng.uniform(0.25, 0.42), rng.uniform(0.04, 0.09)
    beams = {"x": (half, thickness, thickness), "y": (thickness, half, thickness), "z": (thickness, thickness, half)}

    def parts(paint: Paint) -> Shapes:
        return {axis: box((0, 0, 0), beam, paint(1)) for axis, beam in beams.items()}

    points = np.concatenate([_corners(np.array(beam)) for beam in beams.values()])
    return Solid("cross", points, 0.0, parts)


def _rod(rng: np.random.Generator, hangs: bool) -> Solid:
    length, radius = rng.uniform(0.6, 1.1), rng.uniform(0.018, 0.035)
    high = 0.0 if hangs else 0.5 * length
    return _bar("rod", high - length, high, radius, radius)


def _bar(kind: str, low: float, high: float, radius: float, knob: float) -> Solid:
    """Return an upright bar with a ball at either end."""

    def parts(paint: Paint) -> Shapes:
        ends = {name: ball(knob, paint(1), (0, y, 0)) for name, y in (("bottom", low), ("top", high))}
        return {"bar": rod((0, low, 0), (0, high, 0), radius, paint((high - low) / (2 * np.pi * radius))), **ends}

    return Solid(kind, np.array([[0, low, 0], [0, high, 0]]), knob, parts)


def _pendulum(rng: np.random.Generator) -> Solid:
    length, string = rng.uniform(0.5, 1.0), rng.uniform(0.015, 0.03)
    half = rng.uniform(0.10, 0.24) * np.ones(3) if rng.random() < 0.5 else rng.uniform(0.08, 0.22, 3)
    round_bob = half[0] == half[1]

    def parts(paint: Paint) -> Shapes:
        bob = ball(half[0], paint(1), (0, -length, 0)) if round_bob else box((0, -length, 0), half.tolist(), paint(1))
        return {"string": rod((0, 0, 0), (0, -length, 0), string, paint(length / (2 * np.pi * string))), "bob": bob}

    points = np.concatenate([np.zeros((1, 3)), _corners(half) - [0, length, 0]])
    return Solid("pendulum", points, string, parts)


def _corners(half: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(*zip(-half, half, strict=True)), axis=-1).reshape(-1, 3)

"""Textured balls that roll without slipping, bounce and spin in a room: 2 to 6 pixels per frame at
320x240.
"""

from __future__ import annotations

import numpy as np

from morgs_mi.extras.synth.scene import Object, Scene, rotate, translate
from morgs_mi.extras.synth.shapes import ball, disk, rod
from morgs_mi.extras.synth.textures import RGB, lights, pattern, room, textured


def build(seed: int = 0) -> Scene:
    """Return the scene; `seed` determines its textures."""
    balls = {
        "roller": _ball(seed + 10, 0.38, (0.75, 0.20, 0.12), (0.80, 0.70, 0.30), rolling),
        "circler": _ball(seed + 11, 0.28, (0.14, 0.30, 0.70), (0.70, 0.74, 0.78), circling),
        "bouncer": _ball(seed + 12, 0.30, (0.20, 0.62, 0.24), (0.78, 0.72, 0.20), bouncing),
        "spinner": _ball(
            seed + 13, 0.48, (0.60, 0.22, 0.58), (0.66, 0.62, 0.56), spinning, roughness=0.3
        ),
    }
    stone = textured(pattern(seed + 14, (0.40, 0.36, 0.30), (0.24, 0.20, 0.18), 8, 28))
    plinth = {
        "side": rod((0.15, 0, -0.75), (0.15, 0.5, -0.75), 0.34, stone),
        "top": disk((0.15, 0.5, -0.75), 0.34, stone),
    }
    objects = {**room(seed), "plinth": Object(plinth), **balls}
    return Scene("spheres", objects, lights())


def rolling(time: float) -> np.ndarray:
    """Return the pose of a ball that rolls back and forth along x: its angle is minus the distance
    over the radius.
    """
    x = 0.8 * np.sin(1.1 * time - 1.0)
    return translate(x, 0.38, 0.85) @ rotate("z", -x / 0.38)


def circling(time: float) -> np.ndarray:
    """Return the pose of a ball that rolls on a circle of radius 0.62 about an axle through the
    circle's centre.
    """
    angle = 1.4 * time + 0.4
    wheel = translate(0, 0.28, 0.62) @ rotate("z", -0.62 * angle / 0.28)
    return translate(-1.25, 0, -0.35) @ rotate("y", angle) @ wheel


def bouncing(time: float) -> np.ndarray:
    """Return the pose of a ball that bounces on parabolas 0.42 high, 1 s each, while it drifts
    sideways and tumbles.
    """
    phase = (time + 0.2) % 1.0
    height = 0.30 + 0.42 * (1 - (2 * phase - 1) ** 2)
    return (
        translate(1.35 + 0.3 * np.sin(1.3 * time), height, -0.3)
        @ rotate("x", 1.4 * time)
        @ rotate("z", time)
    )


def spinning(time: float) -> np.ndarray:
    """Return the pose of a ball that spins on the plinth, tilted towards the cameras."""
    return translate(0.15, 0.98, -0.75) @ rotate("x", 0.4) @ rotate("y", 2.2 * time)


def _ball(
    seed: int, radius: float, first: RGB, second: RGB, pose, roughness: float | None = None
) -> Object:
    material = textured(pattern(seed, first, second, 8, 24), roughness)
    return Object({"ball": ball(radius, material)}, pose)

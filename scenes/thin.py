"""Thin, fast objects: a propeller, a rope, pendulums and a baton, 4 to 9 pixels wide at 320x240.

Their tips move by 8 to 12 pixels per frame, more than their width, so the regions that a tip covers
in successive frames hardly overlap. The rope is a chain of rigid links, each hinged to the previous
one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from morgs_mi.extras.synth.scene import Object, Scene, rotate, translate
from morgs_mi.extras.synth.shapes import ball, box, rod
from morgs_mi.extras.synth.textures import RGB, lights, pattern, room, textured

BLADES = 3
BLADE = 0.62
LINKS = 7
LINK = 0.19
STRING = 1.10
MAST = (-0.85, 1.12, -0.25)
HOOK = (0.12, 2.02, -0.75)
HINGES = {"pendulum": (0.62, 2.08, 0.05), "far_pendulum": (1.35, 2.16, -0.60)}


def build(seed: int = 0) -> Scene:
    """Return the scene; `seed` determines its textures."""
    wood = _paint(seed + 30, (0.50, 0.34, 0.18), (0.26, 0.16, 0.10), 5)
    steel = _paint(seed + 31, repeat=4)
    blue = _paint(seed + 33, (0.10, 0.28, 0.70), repeat=6)
    green = _paint(seed + 34, (0.16, 0.58, 0.26), repeat=6)
    hemp = _paint(seed + 35, (0.72, 0.60, 0.30), (0.26, 0.18, 0.10))
    red = textured(pattern(seed + 32, (0.76, 0.16, 0.10), (0.80, 0.72, 0.40), 2, 6), repeat=(1, 7))
    blade = box((0.5 * BLADE, 0, 0), (0.5 * BLADE, 0.045, 0.012), red)
    objects = {
        **room(seed),
        "mast": Object({"pole": rod((MAST[0], 0, MAST[2]), MAST, 0.04, steel)}),
        **{
            f"blade{k}": Object({"blade": blade}, partial(propeller, blade=k))
            for k in range(BLADES)
        },
        "hub": Object({"hub": ball(0.075, steel)}, propeller),
        **{
            f"link{k}": Object(
                {"link": rod((0, 0, 0), (0, -LINK, 0), 0.026, hemp), "knot": ball(0.036, hemp)},
                partial(link, index=k),
            )
            for k in range(LINKS)
        },
        "pendulum": _pendulum(blue, wood, pendulum),
        "far_pendulum": _pendulum(green, wood, far_pendulum),
        "baton": Object(
            {"stick": rod((-0.38, 0, 0), (0.38, 0, 0), 0.026, wood), **_ends(0.38, red)}, baton
        ),
    }
    return Scene("thin", objects, lights())


def propeller(time: float, blade: int = 0) -> np.ndarray:
    """Return the pose of a blade, which spins at 5.2 rad/s about a tilted axis; its pitch is 25
    degrees.
    """
    turn = (
        rotate("y", 0.35)
        @ rotate("x", -0.15)
        @ rotate("z", 5.2 * time + 2 * np.pi * blade / BLADES)
    )
    return translate(MAST[0], MAST[1] + 0.05, MAST[2] + 0.12) @ turn @ rotate("x", 0.44)


def link(time: float, index: int) -> np.ndarray:
    """Return the pose of a link of the rope: a travelling wave with an amplitude that grows towards
    the end.
    """
    pose = translate(*HOOK)
    for k in range(index + 1):
        wave = 4.4 * time - 0.55 * k
        bend = rotate("z", (0.10 + 0.05 * k) * np.sin(wave)) @ rotate(
            "x", 0.12 * np.sin(0.7 * wave)
        )
        pose = pose @ (translate(0, -LINK, 0) if k else np.eye(4)) @ bend
    return pose


def pendulum(time: float) -> np.ndarray:
    """Return the pose of the pendulum that swings across the view."""
    return translate(*HINGES["pendulum"]) @ rotate("z", 0.66 * np.sin(3.7 * time + 0.6))


def far_pendulum(time: float) -> np.ndarray:
    """Return the pose of the pendulum that swings at an angle to the view."""
    hinge = translate(*HINGES["far_pendulum"])
    return hinge @ rotate("y", 0.9) @ rotate("z", 0.62 * np.sin(4.0 * time - 1.2))


def baton(time: float) -> np.ndarray:
    """Return the pose of the baton, which tumbles above the floor."""
    place = translate(-0.1 + 0.15 * np.sin(2 * time), 0.42 + 0.12 * np.sin(3 * time), 0.75)
    return place @ rotate("y", 0.5) @ rotate("z", 6.0 * time)


def _pendulum(string: dict, bob: dict, pose: Callable[[float], np.ndarray]) -> Object:
    return Object(
        {
            "rod": rod((0, 0, 0), (0, -STRING, 0), 0.024, string),
            "bob": ball(0.07, bob, (0, -STRING, 0)),
        },
        pose,
    )


def _ends(half: float, material: dict) -> dict[str, dict]:
    return {name: ball(0.05, material, (x, 0, 0)) for name, x in (("left", -half), ("right", half))}


def _paint(
    seed: int, first: RGB = (0.24, 0.26, 0.30), second: RGB = (0.66, 0.64, 0.58), repeat: float = 1
) -> dict:
    """Return a material for a rod `repeat` times as long as its circumference; its squares show
    motion along it.
    """
    return textured(pattern(seed, first, second, 4, 8), repeat=(1, repeat))

"""An articulated robot arm that swings in a room: 5 pixels per frame on average and up to 14 at
320x240.

Every link is rigid. Its pose is its parent's pose times a joint, so the motion of all joints
accumulates at the hand.
"""

from __future__ import annotations

import numpy as np

from morgs_mi.extras.synth.scene import Object, Rig, Scene, rotate, translate
from morgs_mi.extras.synth.shapes import ball, box, disk, rod
from morgs_mi.extras.synth.textures import lights, pattern, room, textured

UPPER = 0.70
FORE = 0.60


def build(seed: int = 0) -> Scene:
    """Return the scene; `seed` determines its textures."""
    steel = textured(pattern(seed + 20, (0.24, 0.26, 0.30), (0.44, 0.42, 0.38), 4, 20))
    orange = textured(pattern(seed + 21, (0.76, 0.34, 0.08), (0.70, 0.56, 0.20), 4, 16))
    blue = textured(
        pattern(seed + 22, (0.14, 0.32, 0.66), (0.60, 0.66, 0.70), 4, 16), roughness=0.3
    )
    green = textured(pattern(seed + 23, (0.20, 0.58, 0.30), (0.76, 0.70, 0.36), 2, 12))
    objects = {
        **room(seed),
        "base": Object({"block": box((0, 0.15, 0), (0.36, 0.15, 0.36), steel)}),
        "turntable": Object(
            {
                "drum": rod((0, 0, 0), (0, 0.25, 0), 0.30, steel),
                "lid": disk((0, 0.25, 0), 0.30, steel),
            },
            turntable,
        ),
        "upper_arm": Object(
            {
                "beam": box((0, 0.5 * UPPER, 0), (0.16, 0.5 * UPPER, 0.16), orange),
                "shoulder": ball(0.26, steel),
            },
            upper_arm,
        ),
        "forearm": Object(
            {
                "beam": box((0, 0.5 * FORE, 0), (0.13, 0.5 * FORE, 0.13), blue),
                "elbow": ball(0.21, orange),
            },
            forearm,
        ),
        "hand": Object(
            {
                "palm": box((0, 0.10, 0), (0.24, 0.07, 0.16), green),
                "finger": box((-0.17, 0.30, 0), (0.07, 0.15, 0.13), orange),
                "thumb": box((0.17, 0.30, 0), (0.07, 0.15, 0.13), blue),
            },
            hand,
        ),
    }
    return Scene("arm", objects, lights(), Rig(center=(0, 1.05, 0), distance=4.6))


def turntable(time: float) -> np.ndarray:
    """Return the pose of the turntable, which rotates about the vertical axis."""
    return translate(0, 0.30, 0) @ rotate("y", 1.0 * np.sin(2.2 * time - 0.3))


def upper_arm(time: float) -> np.ndarray:
    """Return the pose of the upper arm, which rotates at the shoulder."""
    return (
        turntable(time)
        @ translate(0, 0.32, 0)
        @ rotate("z", 0.35 + 0.45 * np.sin(2.4 * time + 2.5))
    )


def forearm(time: float) -> np.ndarray:
    """Return the pose of the forearm, which rotates at the elbow."""
    return (
        upper_arm(time)
        @ translate(0, UPPER, 0)
        @ rotate("z", -1.3 + 0.7 * np.sin(2.3 * time + 2.3))
    )


def hand(time: float) -> np.ndarray:
    """Return the pose of the hand, which twists at the wrist."""
    return forearm(time) @ translate(0, FORE, 0) @ rotate("y", 2.4 * time)

"""A still life under a swinging lamp with a flickering exposure: the light changes everywhere, and
few objects move.

From frame to frame every pixel becomes brighter or darker by up to a tenth in linear light, and
shadows move by several pixels, while a few slow objects move by 1 to 4 pixels per frame at 320x240.
Changes of shadow and light are not motion in the ground truth.
"""

from __future__ import annotations

import numpy as np

from morgs_mi.extras.synth.scene import Light, Object, Scene, rotate, translate
from morgs_mi.extras.synth.shapes import ball, box, disk, rod
from morgs_mi.extras.synth.textures import RGB, lights, pattern, room, textured


def build(seed: int = 0) -> Scene:
    """Return the scene; `seed` determines its textures."""
    stone = _paint(seed + 40, (0.42, 0.38, 0.32), (0.24, 0.20, 0.18))
    clay = _paint(seed + 41, (0.62, 0.32, 0.20), (0.72, 0.52, 0.36))
    slate = _paint(seed + 42, (0.20, 0.26, 0.34), (0.48, 0.52, 0.54))
    moss = _paint(seed + 43, (0.22, 0.48, 0.22), (0.62, 0.60, 0.28))
    plum = _paint(seed + 44, (0.48, 0.16, 0.40), (0.70, 0.52, 0.60))
    objects = {
        **room(seed),
        "column": Object(
            {"side": rod((1.2, 0, -0.7), (1.2, 1.1, -0.7), 0.26, stone)}
            | _top(1.2, 1.1, -0.7, stone)
        ),
        "stack": Object(
            {
                "low": box((-1.2, 0.22, -0.5), (0.42, 0.22, 0.36), slate),
                "high": box((-1.15, 0.60, -0.5), (0.26, 0.16, 0.24), clay),
            }
        ),
        "urn": Object({"urn": ball(0.30, moss, (0.15, 0.30, -1.0))}),
        "turner": Object({"block": box((0, 0, 0), (0.24, 0.30, 0.20), plum)}, turning),
        "roller": Object({"ball": ball(0.27, clay)}, rolling),
        "slider": Object({"block": box((0, 0, 0), (0.16, 0.16, 0.16), moss)}, sliding),
    }
    lamps = lights()
    return Scene(
        "flicker",
        objects,
        {**lamps, "lamp": Light(lamps["lamp"].shape, swinging)},
        exposure=flickering,
    )


def turning(time: float) -> np.ndarray:
    """Return a pose that rotates in place about the vertical axis."""
    return translate(0.05, 0.30, 0.25) @ rotate("y", 1.6 * time)


def rolling(time: float) -> np.ndarray:
    """Return the pose of a ball that rolls back and forth along x without slipping."""
    x = 0.9 + 0.4 * np.sin(1.5 * time)
    return translate(x, 0.27, 0.75) @ rotate("z", -x / 0.27)


def sliding(time: float) -> np.ndarray:
    """Return a pose that slides along the floor towards the cameras and back."""
    return translate(-0.85, 0.16, 0.7 + 0.35 * np.sin(1.8 * time)) @ rotate("y", 0.5)


def swinging(time: float) -> np.ndarray:
    """Return the pose of the lamp, which swings about the vertical through the room's centre."""
    return rotate("y", 0.45 * np.sin(3.0 * time))


def flickering(time: float) -> float:
    """Return the exposure: two sines without a short common period, up to 12 % off their mean."""
    return 1 + 0.07 * np.sin(2 * np.pi * 7.3 * time) + 0.05 * np.sin(2 * np.pi * 4.1 * time + 1.0)


def _top(x: float, y: float, z: float, material: dict) -> dict[str, dict]:
    return {"top": disk((x, y, z), 0.26, material)}


def _paint(seed: int, first: RGB, second: RGB) -> dict:
    return textured(pattern(seed, first, second, 4, 18))

"""Procedural textures, and the walls and lights that the synthetic scenes share.

Optical flow and splats need texture, so every surface has detail at all scales down to a few
pixels. Unlike white noise, a 1/f spectrum has the same contrast at any distance.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from morgs_mi.core.types import SceneDict
from morgs_mi.extras.synth.scene import Light, Object

RGB = tuple[float, float, float]
Vector = tuple[float, float, float]
_SIZE = 512  # texels across


def fractal(rng: np.random.Generator, size: int, finest: float) -> np.ndarray:
    """Return periodic 1/f noise [size, size] of unit variance, at most `finest` cycles across."""
    white = np.fft.rfft2(rng.standard_normal((size, size)))
    frequency = np.hypot(np.fft.fftfreq(size, 1 / size)[:, None], np.fft.rfftfreq(size, 1 / size))
    amplitude = np.where((frequency >= 1) & (frequency <= finest), 1 / np.maximum(frequency, 1), 0)
    noise = np.fft.irfft2(white * amplitude, s=(size, size))
    return noise / noise.std()


def pattern(seed: int, first: RGB, second: RGB, cells: int, finest: float) -> np.ndarray:
    """Return a reflectance texture [512, 512, 3], linear: a checker of two colours under coloured
    noise.

    Args:
        seed: seed of the noise.
        first: one colour of the checker.
        second: the other.
        cells: squares across; an even number gives a periodic texture.
        finest: highest frequency of the noise in cycles across.
    """
    rng = np.random.default_rng(seed)
    shade = fractal(rng, _SIZE, finest)[..., None]
    tint = np.stack([fractal(rng, _SIZE, finest) for _ in range(3)], axis=-1)
    x = np.arange(_SIZE) * cells // _SIZE
    checker = np.where(((x[:, None] + x) % 2)[..., None] == 1, first, second)
    return np.clip(checker * np.exp(0.35 * shade + 0.10 * tint), 0.03, 0.85).astype(np.float32)


def textured(
    texture: np.ndarray, roughness: float | None = None, repeat: tuple[float, float] = (1, 1)
) -> SceneDict:
    """Return a textured Mitsuba material, diffuse or rough plastic.

    Args:
        texture: reflectance [size, size, 3], linear.
        roughness: roughness of the plastic; None for diffuse.
        repeat: repetitions of the texture along u and v, which avoid stretching on long, thin
            shapes.
    """
    to_uv = mi.ScalarTransform4f().scale([*repeat, 1])
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True, "to_uv": to_uv}
    if roughness is None:
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap}}
    return {
        "type": "roughplastic",
        "diffuse_reflectance": bitmap,
        "alpha": roughness,
        "specular_reflectance": 0.5,
    }


def room(
    seed: int, half_width: float = 2.4, height: float = 3.2, depth: float = 1.7
) -> dict[str, Object]:
    """Return a room's floor, back wall and side walls around the origin, open above and towards the
    cameras (+z).
    """
    front = 2.2
    length = 0.5 * (front + depth)
    middle = 0.5 * (front - depth)
    side = (length, 0.5 * height)
    walls = {
        "floor": (
            _wall((0, 0, middle), (1, 0, 0), -90, (half_width, length)),
            pattern(seed, (0.50, 0.42, 0.32), (0.20, 0.22, 0.26), 10, 60),
        ),
        "back": (
            _wall((0, 0.5 * height, -depth), (0, 1, 0), 0, (half_width, 0.5 * height)),
            pattern(seed + 1, (0.30, 0.38, 0.46), (0.46, 0.48, 0.44), 8, 56),
        ),
        "left": (
            _wall((-half_width, 0.5 * height, middle), (0, 1, 0), 90, side),
            pattern(seed + 2, (0.48, 0.26, 0.20), (0.52, 0.44, 0.34), 8, 56),
        ),
        "right": (
            _wall((half_width, 0.5 * height, middle), (0, 1, 0), -90, side),
            pattern(seed + 3, (0.22, 0.42, 0.26), (0.44, 0.50, 0.36), 8, 56),
        ),
    }
    return {
        name: Object({name: {"type": "rectangle", "to_world": to_world, "bsdf": textured(texture)}})
        for name, (to_world, texture) in walls.items()
    }


def _wall(center: Vector, axis: Vector, angle: float, half_size: tuple[float, float]) -> Any:
    """Return the transform of a rectangle with a centre, a rotation in degrees and a half size."""
    return mi.ScalarTransform4f().translate(center).rotate(axis, angle).scale([*half_size, 1])


def lights() -> dict[str, Light]:
    """Return a lamp above the room and a weaker one beside the cameras, which brightens the
    shadows.
    """
    return {
        "lamp": _lamp((1.6, 5.0, 2.6), (0, 0.4, 0), (0, 0, 1), 0.6, (50.0, 46.0, 40.0)),
        "fill": _lamp((-2.0, 3.6, 5.5), (0, 0.8, 0), (0, 1, 0), 0.8, (14.0, 15.0, 17.0)),
    }


def _lamp(origin: Vector, target: Vector, up: Vector, half_size: float, radiance: RGB) -> Light:
    """Return a square lamp that faces a point."""
    look = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=up)
    return Light(
        {
            "type": "rectangle",
            "to_world": look.scale([half_size, half_size, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}},
        }
    )

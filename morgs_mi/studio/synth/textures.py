"""Procedural textures, and the walls and lights that the synthetic scenes share.

Optical flow and splats need texture, so every surface has detail at all scales down to a few
pixels. Unlike white noise, a 1/f spectrum has the same contrast at any distance.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from morgs_mi.studio.synth.scene import Light, Object

RGB = tuple[float, float, float]
_SIZE = 512  # texels across


def fractal(rng: np.random.Generator, size: int, finest: float) -> np.ndarray:
    """Return periodic 1/f noise [size, size] of unit variance, at most `finest` cycles across."""
    frequency = np.hypot(
        *np.meshgrid(np.fft.fftfreq(size, 1 / size), np.fft.rfftfreq(size, 1 / size), indexing="ij")
    )
    amplitude = np.where((frequency >= 1) & (frequency <= finest), 1 / np.maximum(frequency, 1), 0)
    noise = np.fft.irfft2(
        np.fft.rfft2(rng.standard_normal((size, size))) * amplitude, s=(size, size)
    )
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
    x = np.arange(_SIZE) * cells // _SIZE
    checker = ((x[:, None] + x) % 2)[..., None]
    shade = fractal(rng, _SIZE, finest)[..., None]
    tint = np.stack([fractal(rng, _SIZE, finest) for _ in range(3)], axis=-1)
    texture = np.where(checker == 1, first, second) * np.exp(0.35 * shade + 0.10 * tint)
    return np.clip(texture, 0.03, 0.85).astype(np.float32)


def textured(
    texture: np.ndarray, roughness: float | None = None, repeat: tuple[float, float] = (1, 1)
) -> dict[str, Any]:
    """Return a textured Mitsuba material, diffuse or rough plastic.

    Args:
        texture: reflectance [size, size, 3], linear.
        roughness: roughness of the plastic; None for diffuse.
        repeat: repetitions of the texture along u and v, which avoid stretching on long, thin
            shapes.
    """
    import mitsuba as mi

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
    import mitsuba as mi

    T = mi.ScalarTransform4f
    front = 2.2
    length = 0.5 * (front + depth)
    middle = 0.5 * (front - depth)
    walls = {
        "floor": (
            T().translate([0, 0, middle]).rotate([1, 0, 0], -90).scale([half_width, length, 1]),
            pattern(seed, (0.50, 0.42, 0.32), (0.20, 0.22, 0.26), 10, 60),
        ),
        "back": (
            T().translate([0, 0.5 * height, -depth]).scale([half_width, 0.5 * height, 1]),
            pattern(seed + 1, (0.30, 0.38, 0.46), (0.46, 0.48, 0.44), 8, 56),
        ),
        "left": (
            T()
            .translate([-half_width, 0.5 * height, middle])
            .rotate([0, 1, 0], 90)
            .scale([length, 0.5 * height, 1]),
            pattern(seed + 2, (0.48, 0.26, 0.20), (0.52, 0.44, 0.34), 8, 56),
        ),
        "right": (
            T()
            .translate([half_width, 0.5 * height, middle])
            .rotate([0, 1, 0], -90)
            .scale([length, 0.5 * height, 1]),
            pattern(seed + 3, (0.22, 0.42, 0.26), (0.44, 0.50, 0.36), 8, 56),
        ),
    }
    return {
        name: Object({name: {"type": "rectangle", "to_world": to_world, "bsdf": textured(texture)}})
        for name, (to_world, texture) in walls.items()
    }


def lights() -> dict[str, Light]:
    """Return a lamp above the room and a weaker one beside the cameras, which brightens the
    shadows.
    """
    import mitsuba as mi

    T = mi.ScalarTransform4f
    lamp = (
        T().look_at(origin=[1.6, 5.0, 2.6], target=[0, 0.4, 0], up=[0, 0, 1]).scale([0.6, 0.6, 1])
    )
    fill = (
        T().look_at(origin=[-2.0, 3.6, 5.5], target=[0, 0.8, 0], up=[0, 1, 0]).scale([0.8, 0.8, 1])
    )
    return {
        name: Light(
            {
                "type": "rectangle",
                "to_world": to_world,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
            }
        )
        for name, to_world, radiance in (
            ("lamp", lamp, [50.0, 46.0, 40.0]),
            ("fill", fill, [14.0, 15.0, 17.0]),
        )
    }

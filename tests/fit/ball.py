"""A ball of Gaussians in four views: what the tests of the fitting stages share."""

from __future__ import annotations

import dataclasses

import numpy as np

from morgs_mi import Camera, Gaussians, rasterize
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.initialise import from_points


def ball(n: int, sh_degree: int = 0) -> Gaussians:
    """Return n Gaussians in a cube, coloured by position."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.8, 0.8, (n, 3))
    return from_points(points, 0.5 + 0.4 * np.sin(5 * points), sh_degree)


def opaque_ball() -> Gaussians:
    """Return 400 Gaussians, opaque enough to hide what is behind."""
    return dataclasses.replace(ball(400), logit_opacities=np.full(400, 2.0))


def views() -> list[Camera]:
    origins = [(x, y, -3.5) for x in (-0.9, 0.9) for y in (-0.6, 0.6)]
    return [Camera.look_at(o, (0, 0, 0), (0, -1, 0), 40, 64, 48, name=f"cam{i}") for i, o in enumerate(origins)]


def images_of(gaussians: Gaussians) -> list[np.ndarray]:
    return [np.clip(np.asarray(rasterize(gaussians, c, ("color",)).color), 0, 1) for c in views()]


def mean_psnr(gaussians: Gaussians, images: list[np.ndarray]) -> float:
    return float(np.mean([psnr(a, b) for a, b in zip(images_of(gaussians), images, strict=True)]))

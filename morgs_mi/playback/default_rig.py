"""Cameras for Gaussians without a recording: a ring around them, from their extent.

Gaussians of other tools have no cameras, and do not state which direction is up. Their extent along
each axis is that of the middle 90 % of the centres, weighted by opacity: floaters and a far
background do not count. Captured scenes have a side from which they were seen: there the images
have the most detail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.render.rasterize import rasterize

Axes = Literal["y-down", "y-up", "z-up"]
"""Direction that is up, by axis. Files in the layout of 3D Gaussian Splatting mostly have COLMAP's
axes, y down.
"""
DEFAULT_RIG = "default_rig"
"""Entry of a stream's metadata that is true where its cameras are made up, not recorded."""

# Directions up and forward of the first camera.
_DIRECTIONS: dict[Axes, tuple[np.ndarray, np.ndarray]] = {
    "y-down": (np.array([0.0, -1, 0]), np.array([0.0, 0, 1])),
    "y-up": (np.array([0.0, 1, 0]), np.array([0.0, 0, -1])),
    "z-up": (np.array([0.0, 0, 1]), np.array([0.0, 1, 0])),
}
# Every 45 degrees: orbits treat cameras without a gap of 90 degrees as a full circle.
_NAMES = ("front", "front-right", "right", "back-right", "back", "back-left", "left", "front-left")
_WIDTH = 1280
_HEIGHT = 720
_FOV_X = 50.0  # degrees
_THUMBNAIL = 240  # width of the images that are compared
_MOST = 30_000  # Gaussians in them
_PERCENT_OUTSIDE = 5.0  # of the weight, on each side
_MARGIN = 1.1
_LEAST_EXTENT = 1e-6  # of the distance from the origin


def default_rig(frames: Sequence[Gaussians], axes: Axes = "y-down") -> tuple[Camera, ...]:
    """Return eight cameras on a circle around nearly all Gaussians in these frames, which look at
    their middle.

    `front` looks along the forward axis of the convention. The first one is where the first frame
    with Gaussians has the most detail; the others follow counterclockwise, seen from above.

    Raises:
        ValueError: there is no Gaussian in any of the frames.
    """
    low, high, size = _extent(frames)
    # A single Gaussian has no extent but its own, and one without extent is at least larger than
    # rounding errors.
    least = _LEAST_EXTENT * (1 + np.abs((low, high)).max())
    half = np.maximum(_MARGIN * 0.5 * (high - low) + 3 * size, least)
    ring = _ring((low + high) / 2, half, axes)
    some = thinned(next(gaussians for gaussians in frames if len(gaussians)))
    best = int(np.argmax([_detail(some, camera.with_width(_THUMBNAIL)) for camera in ring]))
    return ring[best:] + ring[:best]


def _ring(center: np.ndarray, half: np.ndarray, axes: Axes) -> tuple[Camera, ...]:
    """Return the cameras around a box with half the sides `half` [3], the front one first."""
    up, forward = _DIRECTIONS[axes]
    # The first camera sees the box; the others keep its distance from the middle.
    tall = np.abs(up) @ half
    wide = np.abs(np.cross(forward, up)) @ half
    deep = np.abs(forward) @ half
    distance = deep + max(wide, tall * _WIDTH / _HEIGHT) / np.tan(np.deg2rad(_FOV_X / 2))
    angles = np.linspace(0, 2 * np.pi, len(_NAMES), endpoint=False)
    arms = Rotation.from_rotvec(angles[:, None] * up).apply(-forward)
    return tuple(
        Camera.look_at(center + distance * arm, center, up, _FOV_X, _WIDTH, _HEIGHT, name)
        for name, arm in zip(_NAMES, arms, strict=True)
    )


def thinned(gaussians: Gaussians) -> Gaussians:
    """Return every k-th Gaussian, at most 30,000, enlarged to cover the same area."""
    k = len(gaussians) // _MOST + 1
    some = gaussians.select(np.arange(0, len(gaussians), k))
    return replace(some, log_scales=some.log_scales + 0.5 * np.log(k))


def _detail(gaussians: Gaussians, camera: Camera) -> float:
    """Return the mean difference between neighbouring pixels of a view."""
    image = np.array(rasterize(gaussians, camera, ("color",)).color).clip(0, 1)
    return sum(float(np.abs(np.diff(image, axis=axis)).mean()) for axis in (0, 1))


def _extent(frames: Sequence[Gaussians]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the corners [3] of the box around most of the opacity in all frames, and the median
    size of a Gaussian.
    """
    raw = [gaussians.numpy() for gaussians in frames]
    means, logits = (
        np.concatenate([values[name] for values in raw], dtype=np.float64)
        for name in ("means", "logit_opacities")
    )
    if not len(means):
        raise ValueError("expected at least one Gaussian, got none; leave out files without any.")
    weights = expit(logits) + 1e-9
    percents = (_PERCENT_OUTSIDE, 100 - _PERCENT_OUTSIDE)
    corners = [
        np.percentile(axis, percents, weights=weights, method="inverted_cdf") for axis in means.T
    ]
    low, high = np.array(corners).T
    sizes = np.concatenate([values["log_scales"].max(axis=1, initial=-69) for values in raw])
    return low, high, float(np.exp(np.median(sizes)))

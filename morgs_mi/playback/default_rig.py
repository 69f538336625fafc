"""Cameras for Gaussians without a recording: a ring around them.

Gaussians of other tools do not state which direction is up. What a camera should see is a box.
Along each axis it holds the middle 90 % of the centres, weighted by opacity: floaters and a far
background do not count. Where next to nothing lies far outside of that box, the Gaussians are a
single object, and the box holds all of it. Captured scenes have a side from which they were seen:
there the images have the most detail.
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
BOX = "box"
"""Entry of a stream's metadata with the `scene_box` that made-up cameras see."""
# Directions up and forward of the first camera.
_DIRECTIONS = {
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
# An object: this share of the weight lies in the box of the middle 90 %, widened by this share of
# its sides in each direction. A person's head is within it, a room around a table is not.
_OBJECT_SHARE = 0.97
_OBJECT_REACH = 0.25
_PERCENT_OF_STRAYS = 0.1  # of the weight of an object, on each side
_MARGIN = 1.05
_LEAST_EXTENT = 1e-6  # of the distance from the origin


def scene_box(frames: Sequence[Gaussians]) -> np.ndarray:
    """Return the lower and the upper corner [2, 3] of a box around what matters in these frames:
    all of an object, or nearly all Gaussians of a scene.

    Raises:
        ValueError: there is no Gaussian in any of the frames.
    """
    raw = [gaussians.numpy() for gaussians in frames]
    means, logits = (
        np.concatenate([values[name] for values in raw], dtype=np.float64)
        for name in ("means", "logit_opacities")
    )
    if not len(means):
        raise ValueError("expected at least one Gaussian, got none; leave out files without any.")
    weights = expit(logits) + 1e-9
    low, high = _inner_box(means, weights, _PERCENT_OUTSIDE)
    reach = _OBJECT_REACH * (high - low)
    is_near = ((means >= low - reach) & (means <= high + reach)).all(axis=1)
    if weights[is_near].sum() >= _OBJECT_SHARE * weights.sum():
        low, high = _inner_box(means[is_near], weights[is_near], _PERCENT_OF_STRAYS)
    sizes = np.concatenate([values["log_scales"].max(axis=1, initial=-69) for values in raw])
    # A single Gaussian has no extent but its own, and one without extent is at least larger than
    # rounding errors.
    least = _LEAST_EXTENT * (1 + np.abs((low, high)).max())
    half = np.maximum(_MARGIN * 0.5 * (high - low) + 2 * float(np.exp(np.median(sizes))), least)
    center = (low + high) / 2
    return np.stack([center - half, center + half])


def _inner_box(points: np.ndarray, weights: np.ndarray, percent_outside: float) -> np.ndarray:
    """Return the corners [2, 3] between which a part of the weight of points [N, 3] lies along each
    axis.
    """
    percents = (percent_outside, 100 - percent_outside)
    return np.percentile(points, percents, axis=0, weights=weights, method="inverted_cdf")


def box_corners(box: np.ndarray) -> np.ndarray:
    """Return the eight corners [8, 3] of a box [2, 3]."""
    return np.stack(np.meshgrid(*np.transpose(box)), axis=-1).reshape(8, 3)


def default_rig(
    frames: Sequence[Gaussians], box: np.ndarray, axes: Axes = "y-down"
) -> tuple[Camera, ...]:
    """Return eight cameras on a circle around a `scene_box` [2, 3], which look at its middle and
    see all of it.

    `front` looks along the forward axis of the convention. The first one is where the first of the
    frames that has Gaussians has the most detail; the others follow counterclockwise, seen from
    above.
    """
    ring = _ring(box, axes)
    some = thinned(next(filter(len, frames)))
    details = []  # mean differences between neighbouring pixels
    for camera in ring:
        thumbnail = camera.with_width(_THUMBNAIL)
        image = np.array(rasterize(some, thumbnail, ("color",)).color).clip(0, 1)
        details.append(sum(np.abs(np.diff(image, axis=axis)).mean() for axis in (0, 1)))
    best = int(np.argmax(details))
    return ring[best:] + ring[:best]


def _ring(box: np.ndarray, axes: Axes) -> tuple[Camera, ...]:
    """Return the cameras around a box [2, 3], the front one first."""
    up, forward = _DIRECTIONS[axes]
    angles = np.linspace(0, 2 * np.pi, len(_NAMES), endpoint=False)
    arms = Rotation.from_rotvec(angles[:, None] * up).apply(-forward)
    center = box.mean(axis=0)
    corners = box_corners(box - center)
    toward = corners @ arms.T
    aside = corners @ np.cross(up, arms).T
    # Half of the width that the image needs at each corner [8, 8], for its height as well.
    half_widths = np.maximum(np.abs(aside), np.abs(corners @ up)[:, None] * _WIDTH / _HEIGHT)
    distance = (toward + half_widths / np.tan(np.deg2rad(_FOV_X / 2))).max()
    positions = center + distance * arms
    return tuple(
        Camera.look_at(positions[k], center, up, _FOV_X, _WIDTH, _HEIGHT, name)
        for k, name in enumerate(_NAMES)
    )


def thinned(gaussians: Gaussians) -> Gaussians:
    """Return every k-th Gaussian, at most 30,000, enlarged to cover the same area."""
    k = len(gaussians) // _MOST + 1
    some = gaussians.select(np.arange(0, len(gaussians), k))
    return replace(some, log_scales=some.log_scales + 0.5 * np.log(k))

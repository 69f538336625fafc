"""Points that Gaussians start from where few cameras stand far apart around a scene.

Such views share the floor, and what stands on it before all cameras. One camera alone sees whatever
is behind, at an unknown depth. Gaussians of it that start between the cameras stay there, and are
debris in all other views. These points leave the space between the cameras to what several see:

- the floor: of all planes around the focus of the rig, the one on which the views agree most;
- objects: random points around the focus on whose colour all views agree, where chance does not
  explain it;
- the backdrop: a sphere around the cameras, in the colours of all other pixels.

Views agree on a point if they show it, slightly blurred, in nearly the same colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np

from morgs_mi.core.camera import Camera, unit_vectors
from morgs_mi.core.color_space import unit_values
from morgs_mi.core.rig import Focus, focus_point, positions_of, up_direction
from morgs_mi.core.view import View
from morgs_mi.fit.forecast import are_far_apart
from morgs_mi.fit.view import random_pixels, shares_of, shown_colors
from morgs_mi.platform.checks import valid_pixels

# Width to which compared views are reduced, px.
_WIDTH = 128
# Standard deviation of the blur of their images, px: poses of wide rigs are off by a pixel.
_BLUR = 1.2
# Largest difference of the colours of one point in two views, which light it from other sides.
_SAME = 0.1
# Least difference of the colours of different points.
_OTHER = 0.2
# Radii of the objects, the floor and the backdrop, in mean distances of the cameras from the focus.
_OBJECTS = 0.4
_FLOOR = 1.35
_BACKDROP = 3.0
# Pixels of each view by which planes are compared.
_SAMPLES = 500
# Heights of planes above the focus, in these distances: from, to, and step.
_HEIGHTS = (-0.8, 0.03, 0.05)
# Step of the tilts of their normals.
_TILT = 0.1
# Number of times that both steps are halved around the best plane.
_HALVINGS = 4
# Number of random candidates for the points of objects.
_CANDIDATES = 200_000
# Most of them that are compared with chance.
_CHECKED = 5_000
# Pixels of a view that stand for its colours.
_PIXELS = 500
# Largest probability that all views show the same colour by chance. It is below 1e-4 for points of
# a person, and 1e-2 for white walls in three views.
_CHANCE = 1e-3
# Least height of objects above the floor, in distances of the cameras.
_ABOVE = 0.012
# Largest share of the points that objects have.
_OBJECT_SHARE = 0.15


class PointCloud(NamedTuple):
    """Points with colours."""

    positions: np.ndarray  #: [P, 3], world units.
    colors: np.ndarray  #: [P, 3], encoded: 1 is white.

    @property
    def count(self) -> int:
        """P."""
        return len(self.positions)

    def select(self, rows: np.ndarray | slice) -> PointCloud:
        """Return some of the points, by indices or by a mask [P]."""
        return PointCloud(self.positions[rows], self.colors[rows])

    @staticmethod
    def joined(parts: Sequence[PointCloud]) -> PointCloud:
        """Return several point clouds, one after the other, as one."""
        return PointCloud(
            np.concatenate([part.positions for part in parts]),
            np.concatenate([part.colors for part in parts]),
        )


@dataclass(frozen=True, eq=False)
class _Plane:
    """The points x with normal . x = height."""

    normal: np.ndarray  # [3], of unit length
    height: float

    def hits(self, camera: Camera, pixels: np.ndarray) -> np.ndarray:
        """Return the points [P, 3] that a camera sees at pixel positions [P, 2], NaN where the
        plane is behind it.
        """
        origin, directions = camera.rays(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            distances = (self.height - origin @ self.normal) / (directions @ self.normal)
        return origin + np.where(distances > 0, distances, np.nan)[:, None] * directions


@dataclass(frozen=True, eq=False)
class _Rig:
    """Views that look at one place, reduced."""

    #: With blurred images [H, W, 3], encoded, NaN in pixels that are not used.
    views: tuple[View, ...]
    focus: np.ndarray  #: Point [3] that all cameras look at.
    distance: float  #: Mean distance of the cameras from it.

    @classmethod
    def of(cls, views: Sequence[View]) -> _Rig:
        cameras = [view.camera for view in views]
        focus = focus_point(cameras)
        distance = float(np.linalg.norm(positions_of(cameras) - focus, axis=1).mean())
        return cls(tuple(map(_blurred, views)), focus, distance)

    def shown(self, points: np.ndarray) -> np.ndarray:
        """Return the colours [V, P, 3] in which the views show points [P, 3], NaN where they do
        not.
        """
        return np.stack([shown_colors(view, points) for view in self.views])

    def is_near(self, points: np.ndarray, radius: float) -> np.ndarray:
        """Return which points [P, 3] are nearer to the focus than a radius, in distances of the
        cameras.
        """
        return np.linalg.norm(points - self.focus, axis=1) < radius * self.distance


def _blurred(view: View) -> View:
    """Return a view reduced in width, unless that leaves no valid pixel, with a blurred image."""
    reduced = view.reduced(_WIDTH)
    if valid_pixels(reduced.mask, reduced.image.shape).any():
        view = reduced
    image = cv2.GaussianBlur(unit_values(view.image, np.float32), (0, 0), _BLUR)
    image[~valid_pixels(view.mask, image.shape)] = np.nan
    return view.at(image)


def are_around(cameras: Sequence[Camera]) -> bool:
    """Return whether cameras are few, far apart, and look at one place."""
    focus = Focus.of(cameras)
    is_one_place = all(np.isfinite(focus.depth(camera)) for camera in cameras)
    return is_one_place and are_far_apart(cameras, np.zeros((0, 3)))


def far_points(views: Sequence[View], count: int, rng: np.random.Generator) -> PointCloud:
    """Return points [count, 3] of objects, the floor and the backdrop, and their colours
    [count, 3].

    Args:
        views: V views that look at one place, at least two.
        count: number of points.
        rng: draws pixels and points.
    """
    views = [view for view in views if valid_pixels(view.mask, view.image.shape).any()]
    rig = _Rig.of(views)
    floor = _floor(rig, rng)
    objects = _objects(rig, floor, round(_OBJECT_SHARE * count), rng)
    parts = []
    for view, share in shares_of(count - objects.count, views):
        pixels, colors = random_pixels(view, share, rng)
        points = floor.hits(view.camera, pixels)
        is_behind = ~rig.is_near(points, _FLOOR)
        points[is_behind] = _on_backdrop(rig, view.camera, pixels[is_behind])
        parts.append(PointCloud(points, colors))
    return PointCloud.joined([objects, *parts])


def _floor(rig: _Rig, rng: np.random.Generator) -> _Plane:
    """Return the plane on which the views agree most, of those below the focus of the rig and
    around it.
    """
    up = up_direction([view.camera for view in rig.views])
    east = unit_vectors(np.cross(up, np.eye(3)[np.abs(up).argmin()]))
    north = np.cross(up, east)
    samples = []
    for view in rig.views:
        rows, columns = np.nonzero(np.isfinite(view.image[..., 0]))
        chosen = rng.permutation(len(rows))[:_SAMPLES]
        pixels = np.stack([columns[chosen], rows[chosen]], axis=1) + 0.5
        samples.append((view.camera, pixels, view.image[rows[chosen], columns[chosen]]))

    some = np.concatenate([colors for _, _, colors in samples])[:: len(samples)]
    by_chance = [_alike(colors[:, None], some).mean(axis=1) for _, _, colors in samples]

    def plane(height: float, tilt_east: float, tilt_north: float) -> _Plane:
        normal = unit_vectors(up + tilt_east * east + tilt_north * north)
        return _Plane(normal, float(normal @ rig.focus + height * rig.distance))

    def agreement(parameters: tuple[float, float, float]) -> float:
        """Return by how much more the views agree than by chance, as they do on plain walls."""
        total = 0.0
        for view, (camera, pixels, colors) in enumerate(samples):
            points = plane(*parameters).hits(camera, pixels)
            points[~rig.is_near(points, _FLOOR)] = np.nan
            gain = _alike(colors, rig.shown(points)) - by_chance[view]
            gain[view] = 0
            total += np.nansum(gain)
        return total

    tilts = np.arange(-2, 3) * _TILT
    best = max(product(np.arange(*_HEIGHTS), tilts, tilts), key=agreement)
    for k in range(1, _HALVINGS + 1):
        steps = np.array([_HEIGHTS[2], _TILT, _TILT]) / 2**k
        around = [tuple(best + steps * shift) for shift in product((-1, 0, 1), repeat=3)]
        best = max(around, key=agreement)
    return plane(*best)


def _alike(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how much colours [..., 3] are alike [...], from 0 to 1."""
    return np.maximum(1 - np.abs(a - b).max(axis=-1) / _OTHER, 0)


def _objects(rig: _Rig, floor: _Plane, count: int, rng: np.random.Generator) -> PointCloud:
    """Return at most `count` points on whose colour all views agree, above the floor, and their
    colours.
    """
    hidden = []
    for index, view in enumerate(rig.views):
        height, width = view.image.shape[:2]
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
        points = floor.hits(view.camera, pixels)
        points[~rig.is_near(points, _FLOOR)] = np.nan
        difference = np.abs(rig.shown(points) - view.image.reshape(-1, 3)).max(axis=2)
        difference[index] = np.inf
        is_floor = (difference < _SAME).any(axis=0)
        hidden.append(view.at(np.where(is_floor.reshape(height, width, 1), np.nan, view.image)))
    above = replace(rig, views=tuple(hidden))
    ball = rng.normal(size=(_CANDIDATES, 3))
    ball = unit_vectors(ball) * rng.uniform(0, 1, (_CANDIDATES, 1)) ** (1 / 3)
    points = rig.focus + _OBJECTS * rig.distance * ball
    points = points[points @ floor.normal > floor.height + _ABOVE * rig.distance]
    shown = above.shown(points)
    colors = shown.mean(axis=0)
    agrees = np.abs(shown - colors).max(axis=(0, 2)) < _SAME
    chosen = rng.permutation(np.flatnonzero(agrees))[:_CHECKED]
    points = points[chosen]
    colors = colors[chosen]
    chance = np.ones(len(points))
    for view in rig.views:
        some = rng.permutation(view.image[np.isfinite(view.image[..., 0])])[:_PIXELS]
        alike = np.abs(colors[:, None] - some).max(axis=2) < _SAME
        chance *= alike.sum(axis=1) / max(len(some), 1)
    is_object = chance < _CHANCE
    return PointCloud(points[is_object][:count], colors[is_object][:count].astype(np.float64))


def _on_backdrop(rig: _Rig, camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the points [P, 3] of the backdrop that a camera sees at pixel positions [P, 2]."""
    origin, directions = camera.rays(pixels)
    offset = origin - rig.focus
    along = directions @ offset
    radius = _BACKDROP * rig.distance
    root = np.sqrt(np.maximum(along**2 - offset @ offset + radius**2, 0))
    return origin + (root - along)[:, None] * directions

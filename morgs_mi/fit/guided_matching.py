"""Matches of views that are too far apart to be matched without their poses.

Only features on each other's epipolar lines are compared. A match is accepted if the patches that
the two features describe agree. Take a patch at the triangulated point, on a plane that faces both
cameras. Seen from the other camera, it must have about the size and the orientation of the other
feature. Without this test, half of the matches at 60 degrees are wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from morgs_mi.core.camera import Camera, unit_vectors
from morgs_mi.fit.features import (
    Features,
    Match,
    SharedFeatures,
    descriptor_distances,
    intersect_pairs,
    mutual_neighbours,
)

# Largest distance from an epipolar line, px, and between two descriptors of length 1.
_BAND = 1.0
_MAX_DISTANCE = 0.9
# Largest difference of the patches in size, octaves, and in orientation, degrees.
_MAX_OCTAVES = 0.7
_MAX_TURN = 30.0
# Distance of two cameras that rounding can cause, relative to their distance from the origin.
_ROUNDING = 1e-9


def match_guided(
    shared: SharedFeatures, cameras: Sequence[Camera], pairs: Iterable[tuple[int, int]]
) -> list[Match]:
    """Return the matches of pairs of views, found with the poses of their cameras."""
    matches = []
    for i, j in pairs:
        a = shared.features[i]
        b = shared.features[j]
        if min(len(a.points), len(b.points)) < 2:
            continue
        distances = descriptor_distances(a, b)
        near = _line_distances(a.points, b.points, cameras[i], cameras[j]) <= _BAND
        rows = mutual_neighbours(np.where(near & (distances <= _MAX_DISTANCE), distances, 2.0))
        rows = rows[_patches_agree(a, b, rows, cameras[i], cameras[j])]
        if len(rows):
            matches.append(Match((i, j), rows))
    return matches


def _line_distances(x: np.ndarray, y: np.ndarray, a: Camera, b: Camera) -> np.ndarray:
    """Return the larger distance of two pixel positions, [K, 2] and [L, 2], from each other's
    lines, [K, L], px.
    """
    centres = np.array([a.position, b.position])
    if np.linalg.norm(centres[1] - centres[0]) <= _ROUNDING * np.linalg.norm(centres):
        return np.full((len(x), len(y)), np.inf)  # two cameras at one position have no lines
    fundamental = _fundamental(a, b)
    x = np.column_stack([x, np.ones(len(x))])
    y = np.column_stack([y, np.ones(len(y))])
    of_x = x @ fundamental.T
    of_y = y @ fundamental
    slopes = np.minimum(np.hypot(*of_x[:, :2].T)[:, None], np.hypot(*of_y[:, :2].T))
    with np.errstate(divide="ignore", invalid="ignore"):  # the epipoles have no lines
        return np.abs(of_x @ y.T) / slopes


def _fundamental(a: Camera, b: Camera) -> np.ndarray:
    """Return the fundamental matrix [3, 3], by which a pixel of `a` has its line in `b`."""
    relative = b.world_to_camera @ np.linalg.inv(a.world_to_camera)
    essential = np.cross(relative[:3, 3], relative[:3, :3], axisb=0, axisc=0)
    return np.linalg.inv(b.K).T @ essential @ np.linalg.inv(a.K)


def _patches_agree(
    a: Features, b: Features, pairs: np.ndarray, first: Camera, second: Camera
) -> np.ndarray:
    """Return whether the patches of each pair [M, 2] agree in size and orientation, [M]."""
    pixels = np.concatenate([a.points[pairs[:, 0]], b.points[pairs[:, 1]]])
    points = intersect_pairs(pixels, (0, 1), (first, second))
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = _carried(points, a.axes[pairs[:, 0]], first, second)
        axes = b.axes[pairs[:, 1]]
        expected_length = np.linalg.norm(expected, axis=1)
        length = np.linalg.norm(axes, axis=1)
        octaves = np.log2(expected_length / length)
        cosines = (expected * axes).sum(axis=1) / expected_length / length
    return (np.abs(octaves) <= _MAX_OCTAVES) & (cosines >= np.cos(np.deg2rad(_MAX_TURN)))


def _carried(points: np.ndarray, vectors: np.ndarray, first: Camera, second: Camera) -> np.ndarray:
    """Return image vectors at points [M, 3] as another camera sees them [M, 2], on planes that face
    both cameras.
    """
    rays = [points - camera.position for camera in (first, second)]
    normals = sum(map(unit_vectors, rays))
    directions = (
        first.unproject(first.project(points)[0] + vectors, np.ones(len(points))) - first.position
    )
    scale = (rays[0] * normals).sum(axis=1) / (directions * normals).sum(axis=1)
    ends = first.position + scale[:, None] * directions
    return second.project(ends)[0] - second.project(points)[0]

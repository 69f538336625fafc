"""Forecast of views between the cameras, from the angles between neighbouring cameras and their overlap alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.fit.initialise import focus_point, scene_extent, seen_points

__all__ = ["Forecast", "angles_to", "forecast", "scene_depths"]


@dataclass(frozen=True)
class Forecast:
    """What a rig lets expect of views between its cameras.

    Attributes:
        cameras: number of cameras.
        spacing: mean angle from a camera to its nearest one, as seen from what they look at, degrees.
        overlap: mean share of a camera's image that another camera sees as well.
    """

    cameras: int
    spacing: float
    overlap: float


def forecast(cameras: Sequence[Camera], points: np.ndarray) -> Forecast:
    """Return the forecast for a rig.

    Args:
        cameras: those that are trained on, at least two.
        points: [P, 3] of the scene, world units; without any, what the cameras look at is their `focus_point`.
    """
    depths = scene_depths(cameras, points)
    spacing, overlap = [], []
    for view, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        others = [*cameras[:view], *cameras[view + 1 :]]
        spacing.append(angles_to(camera, depth, others).min())
        overlap.append(_shared(camera, depth, others))
    return Forecast(len(cameras), float(np.mean(spacing)), float(np.mean(overlap)))


def scene_depths(cameras: Sequence[Camera], points: np.ndarray) -> list[float]:
    """Return the median depth of the points in each view, world units.

    For a view without points it is that of the `focus_point`, or far away if that is not in front of the camera.
    """
    focus, far = focus_point(cameras), 1e6 * scene_extent(cameras)
    depths = []
    for camera in cameras:
        _, _, seen = seen_points(camera, points)
        middle = float(np.median(seen)) if len(seen) else float(camera.project(focus)[1])
        depths.append(middle if middle > camera.near else far)
    return depths


def angles_to(camera: Camera, depth: float, others: Sequence[Camera]) -> np.ndarray:
    """Return the angles to other cameras, as seen from the point at a depth in the middle of the image, degrees."""
    middle = camera.unproject(np.array([[camera.width / 2, camera.height / 2]]), np.array([depth]))[0]
    rays = np.array([c.position for c in (camera, *others)]) - middle
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.rad2deg(np.arccos(np.clip(rays[1:] @ rays[0], -1, 1)))


def _shared(camera: Camera, depth: float, others: Sequence[Camera]) -> float:
    """Return the share of an image that other cameras see too if everything is at one depth."""
    x, y = (np.linspace(0, 1, 33)[1::2] * side for side in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = camera.unproject(pixels, np.full(len(pixels), depth))
    return float(np.mean(np.any([seen_points(other, points)[0] for other in others], axis=0)))

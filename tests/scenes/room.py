"""A red ball above the floor of a large room, and few cameras far apart around it."""

import numpy as np

from morgs_mi.core.view import View
from tests.scenes.cameras import circle, look_at_cameras

FLOOR = -0.8
"""Height of the floor."""
CENTRE = np.array([0.1, -0.1, 0.1])
"""Centre of the ball."""
RADIUS = 0.5
"""Radius of the ball."""
WALL = 8.0
"""Distance of the walls."""


def colors_of(points, frequency):
    """Return smooth colours [P, 3] of points on surfaces."""
    phases = points @ np.array([[1.0, 0.3, 0.2], [0.2, 1.1, -0.4], [-0.3, 0.2, 1.2]])
    return 0.5 + 0.3 * np.sin(frequency * phases + [0, 2, 4])


def room_view(camera):
    """Return the view of a red ball above a floor, between walls far away."""
    rows, columns = np.indices((camera.height, camera.width))
    origin, rays = camera.rays(np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5)
    with np.errstate(divide="ignore"):
        floor = (FLOOR - origin[2]) / rays[:, 2]
    floor = np.where(floor > 0, floor, np.inf)
    along = rays @ origin
    wall = -along + np.sqrt(along**2 - origin @ origin + WALL**2)
    offset = origin - CENTRE
    along = rays @ offset
    root = along**2 - offset @ offset + RADIUS**2
    ball = np.where(root > 0, -along - np.sqrt(np.maximum(root, 0)), np.inf)
    distance = np.minimum(np.minimum(floor, wall), ball)
    points = origin + distance[:, None] * rays
    colors = np.where((floor < wall)[:, None], colors_of(points, 4), colors_of(points, 1))
    colors[ball <= distance] = 0.8, 0.1, 0.1
    image = np.round(255 * colors).astype(np.uint8).reshape(*rows.shape, 3)
    return View(camera, image)


def rig(count=4):
    """Return cameras on a circle above the floor, which look at the ball."""
    angles = np.arange(count) * 2 * np.pi / count
    origins = [(x, y, 0.6 + 0.2 * k) for k, (x, y, _) in enumerate(circle(angles, 3))]
    return look_at_cameras(origins, 60, 64, 48, up=(0, 0, 1))

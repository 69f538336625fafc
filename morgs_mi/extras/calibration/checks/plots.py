"""Plot of a capture's rig, seen from above and from the side."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from math import ceil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import central_distances, positions_of, up_direction
from morgs_mi.platform.plots import check_plot, save_plot

# Inches.
_WIDTH = 14.4
_HEIGHT = 7.6
_IMAGE_HEIGHT = 1.5
_IMAGES_PER_ROW = 10
_IMAGE_SIZE = 240  # pixels of the longer side
# Points of print.
_FONT_SIZE = 8
_PANEL = 400
# Width of a letter and height of a line of a font.
_LETTER = 0.62
_LINE = 1.3
# Distances of a name from its camera in points, and angles from the direction behind the camera.
_DISTANCES = np.array([8, 18, 30, 44, 60, 80, 105, 130])
_ANGLES = np.deg2rad((0, 25, -25, 50, -50, 75, -75))
# Colour of a camera, and of a held-out one.
_USUAL = "tab:blue"
_MARKED = "tab:red"
# Colours of the axes of the world.
_AXIS_COLORS = ("indianred", "seagreen", "royalblue")
_MAX_POINTS = 20_000
# The edges of a frustum as one line through its centre 0 and its corners 1 to 4.
_EDGES = [0, 1, 2, 3, 4, 1, 0, 2, 0, 3, 0, 4]


def write_rig(path: Path, capture: Capture) -> None:
    """Write the plot of a capture's rig; the file is written atomically.

    Args:
        path: .png, .jpg, .svg or .pdf.
        capture: the capture.

    Raises:
        ValueError: as `check_plot`.
        OSError: the file cannot be written.
    """
    check_plot(path)
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    # Names may contain dollars, and letters that the font lacks and draws as boxes.
    with rc_context({"text.parse_math": False}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        height = _IMAGE_HEIGHT * ceil(len(capture.cameras) / _IMAGES_PER_ROW)
        figure: Any = Figure(figsize=(_WIDTH, _HEIGHT + height), layout="constrained")
        upper, lower = figure.subfigures(2, 1, height_ratios=(_HEIGHT, height))
        points = (capture.points, capture.point_colors)
        draw_rig(upper, capture.cameras, points, capture.test_views)
        _draw_images(lower, capture)
        save_plot(path, figure, "write_rig()")


def _draw_images(figure: Any, capture: Capture) -> None:
    """Draw the first image of each camera, in a frame of the camera's colour."""
    images = next(capture.displayed().partial_frames(0, 1)).images
    rows = ceil(len(images) / _IMAGES_PER_ROW)
    grid = figure.subplots(rows, ceil(len(images) / rows), squeeze=False).ravel()
    for axes in grid:
        axes.set(xticks=[], yticks=[], frame_on=False)
    for view, image in enumerate(images):
        axes = grid[view]
        axes.set_title(capture.names[view], fontsize=_FONT_SIZE)
        axes.set_frame_on(True)
        axes.spines[:].set(color=_color(view, capture.test_views), linewidth=2)
        if image is not None:
            scale = min(1, _IMAGE_SIZE / max(image.shape))
            axes.imshow(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _color(view: int, test_views: Collection[int]) -> str:
    return _MARKED if view in test_views else _USUAL


def draw_rig(
    figure: Any,
    cameras: Sequence[Camera],
    points: tuple[np.ndarray, np.ndarray],
    test_views: Collection[int] = (),
) -> None:
    """Plot the cameras' frusta and names, the points and the world axes, in world units.

    Up is the mean of the cameras' up directions, forward the mean of their viewing directions. The
    left half is seen from above with forward to the top, the right half from the right with forward
    to the right.

    Args:
        figure: an empty figure of matplotlib.
        cameras: the rig.
        points: positions [P, 3] in world units and colours [P, 3] in [0, 1]; distant ones are cut
            off.
        test_views: indices of the held-out cameras, drawn in red.
    """
    right, forward, up = _directions(cameras)
    positions = positions_of(cameras)
    middle = positions.mean(0)
    radius = central_distances(positions).max() or 1.0
    # The centre of each camera, and the corners of its image at a depth.
    frusta = []
    for camera in cameras:
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * camera.size
        frusta += [camera.position, *camera.unproject(corners, np.full(4, 0.25 * radius))]
    frusta = np.array(frusta) - middle
    places, colors = (values[:: max(1, len(values) // _MAX_POINTS)] for values in points)
    near = np.linalg.norm(places - middle, axis=1) < 8 * radius
    places = places[near] - middle
    core = np.percentile(places, [1, 99], axis=0) if len(places) else places
    panels = (
        ("From above", "right", "forward", [right, forward]),
        ("From the right", "forward", "up", [forward, up]),
    )
    for place, (title, x, y, plane) in enumerate(panels, 1):
        axes = figure.add_subplot(1, 2, place)
        plane = np.transpose(plane)
        axes.set_title(title, fontsize=11, loc="left")
        axes.set(xlabel=f"{x}, world units", ylabel=f"{y}, world units")
        axes.scatter(*(places @ plane).T, s=1, c=np.clip(colors[near], 0, 1), rasterized=True)
        # The panel is a square around the frusta and most points, with a margin.
        bounds = np.concatenate([frusta, core]) @ plane
        half = 0.65 * max(np.ptp(bounds, axis=0).max(), 1e-12)
        xlim, ylim = (bounds.min(0) + bounds.max(0))[:, None] / 2 + (-half, half)
        axes.set(xlim=xlim, ylim=ylim, aspect="equal", axisbelow=True)
        axes.grid(color="0.9")
        views = (frusta @ plane).reshape(-1, 5, 2)
        names = [camera.name for camera in cameras]
        name_places = _places_beside(views, names, 2 * half / _PANEL)
        for view, frustum in enumerate(views):
            color = _color(view, test_views)
            axes.plot(*frustum[_EDGES].T, color=color, linewidth=1)
            axes.plot(*frustum[0], "o", color=color, markersize=4)
            axes.annotate(
                names[view],
                frustum[0],
                name_places[view],
                ha="center",
                va="center",
                fontsize=_FONT_SIZE,
                arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.5, "shrinkA": 0},
            )
        # The world's axes in the corner of the panel.
        for axis, direction in enumerate(plane):
            if np.linalg.norm(direction) > 0.4:
                axes.annotate(
                    "xyz"[axis],
                    (0.12, 0.12),
                    xycoords="axes fraction",
                    xytext=36 * direction,
                    textcoords="offset points",
                    color=_AXIS_COLORS[axis],
                    arrowprops={"arrowstyle": "<-", "color": _AXIS_COLORS[axis]},
                )

    axes.plot([], [], "o-", color=_USUAL, markersize=4, label="camera")
    if test_views:
        axes.plot([], [], "o-", color=_MARKED, markersize=4, label="held-out camera")
    if len(places):
        axes.plot([], [], "o", color="0.5", markersize=2, label="point of the scene")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False)


def _places_beside(frusta: np.ndarray, names: Sequence[str], unit: float) -> np.ndarray:
    """Return places [V, 2] for the middles of names, behind the cameras of frusta [V, 5, 2] or
    beside that, where they overlap neither cameras nor each other, if there is room.

    Args:
        frusta: centre and corners of each camera, in a panel.
        names: of the cameras.
        unit: size of a point of print in the panel.
    """
    centres = list(frusta[:, 0])
    sizes = [np.zeros(2)] * len(names)
    for view, name in enumerate(names):
        camera = frusta[view, 0]
        size = unit * _FONT_SIZE * np.array([_LETTER * len(name), _LINE])
        x, y = camera - frusta[view, 1:].mean(axis=0)
        angles = np.arctan2(y, x) + _ANGLES
        rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        steps = unit * _DISTANCES[:, None, None] + size / 2
        candidates = (camera + steps * rays).reshape(-1, 2)
        gaps = np.abs(candidates[:, None] - centres) - (sizes + size) / 2
        is_free = (gaps > 0).any(axis=2).all(axis=1)
        centres.append(candidates[is_free.argmax()])
        sizes.append(size)
    return np.array(centres[len(names) :])


def _directions(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rig's right, forward and up [3, 3], orthonormal."""
    up = up_direction(cameras)
    rotations = np.array([camera.rotation for camera in cameras])
    # Forward is the first of these that is not vertical. Cameras all around a scene have no common
    # forward direction: use the first camera's direction.
    candidates = np.array([rotations[:, 2].mean(0), rotations[0, 2], np.cross(up, rotations[0, 0])])
    level = candidates - np.outer(candidates @ up, up)
    forward = next(vector / length for vector in level if (length := np.linalg.norm(vector)) > 1e-3)
    return np.stack([np.cross(forward, up), forward, up])

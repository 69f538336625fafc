"""Plot of a capture's rig, seen from above and from the side."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
from morgs_mi.core.plots import check_plot, save_plot
from morgs_mi.core.rig import central_distances, positions_of, up_direction

# Inches.
_WIDTH = 14.4
_HEIGHT = 7.6
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
        figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
        points = (capture.points, capture.point_colors)
        draw_rig(figure, capture.cameras, points, capture.test_views)
        save_plot(path, figure, "write_rig()")


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
    for axes, (title, x, y, plane) in zip(figure.subplots(1, 2), panels, strict=True):
        plane = np.transpose(plane)
        axes.set_title(title, fontsize=11, loc="left")
        axes.set(xlabel=f"{x}, world units", ylabel=f"{y}, world units")
        axes.scatter(*(places @ plane).T, s=1, c=np.clip(colors[near], 0, 1), rasterized=True)
        for view, frustum in enumerate((frusta @ plane).reshape(-1, 5, 2)):
            color = _MARKED if view in test_views else _USUAL
            axes.plot(*frustum[_EDGES].T, color=color, linewidth=1)
            axes.plot(*frustum[0], "o", color=color, markersize=4)
            name = cameras[view].name or str(view)
            axes.annotate(name, frustum[0], xytext=(4, 4), textcoords="offset points", fontsize=8)
        # The panel is a square around the frusta and most points, with a margin.
        bounds = np.concatenate([frusta, core]) @ plane
        half = 0.6 * max(np.ptp(bounds, axis=0).max(), 1e-12)
        xlim, ylim = (bounds.min(0) + bounds.max(0))[:, None] / 2 + (-half, half)
        axes.set(xlim=xlim, ylim=ylim, aspect="equal", axisbelow=True)
        axes.grid(color="0.9")
        # The world's axes in the corner of the panel.
        for name, color, direction in zip("xyz", _AXIS_COLORS, plane, strict=True):
            if np.linalg.norm(direction) > 0.4:
                axes.annotate(
                    name,
                    (0.12, 0.12),
                    xycoords="axes fraction",
                    xytext=36 * direction,
                    textcoords="offset points",
                    color=color,
                    arrowprops={"arrowstyle": "<-", "color": color},
                )


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

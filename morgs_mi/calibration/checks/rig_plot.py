"""Plot of the rig: cameras and points seen from above and from the side."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.calibration.checks.deep import DeepCheck
from morgs_mi.calibration.checks.deep_plot import draw_deep
from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
from morgs_mi.core.files import atomic_path

__all__ = ["check_plot", "draw_rig", "write_rig"]

_SUFFIXES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")
_WIDTH, _RIG_HEIGHT, _DEEP_HEIGHT, _DPI = 14.4, 7.6, 9.0, 100  # inches, dots per inch
_HELD_OUT, _TRAINING = "tab:red", "tab:blue"
_AXES = (("x", "firebrick"), ("y", "forestgreen"), ("z", "mediumblue"))
_MAX_POINTS = 20_000
# The edges of a frustum as one line through its centre 0 and its corners 1 to 4.
_EDGES = [0, 1, 2, 3, 4, 1, 0, 2, 0, 3, 0, 4]


def check_plot(path: Path) -> None:
    """Check that a plot can be written.

    Raises:
        ValueError: the name has another suffix, or matplotlib is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise ValueError(f"{path}: the suffix of a plot must be .png, .jpg, .svg or .pdf, got {suffix!r}; rename it.")
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ValueError(f"{path}: a plot needs the package matplotlib; pip install 'morgs-mi[plots]'.") from None


def write_rig(path: Path, capture: Capture, deep: DeepCheck | None = None) -> None:
    """Write the plot of a capture's rig, and below it the plot of a check; the file is written atomically.

    Args:
        path: .png, .jpg, .svg or .pdf.
        capture: the capture.
        deep: check of its frames.

    Raises:
        ValueError: as `check_plot`.
        OSError: the file cannot be written.
    """
    check_plot(path)
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    heights, data = [_RIG_HEIGHT, *([_DEEP_HEIGHT] if deep else [])], BytesIO()
    # Names may contain dollars, and letters that the font lacks and draws as boxes.
    with rc_context({"text.parse_math": False}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure = Figure(figsize=(_WIDTH, sum(heights)), layout="constrained")
        rows = figure.subfigures(len(heights), height_ratios=heights, squeeze=False)[:, 0]
        draw_rig(rows[0], capture.cameras, (capture.points, capture.point_colors), capture.test_views)
        if deep:
            draw_deep(rows[1], deep)
        figure.savefig(data, format=path.suffix[1:].lower(), dpi=_DPI)
    with atomic_path(path, "write_rig()") as partial:
        partial.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data.getbuffer())


def draw_rig(
    figure: Any, cameras: Sequence[Camera], points: tuple[np.ndarray, np.ndarray], test_views: Collection[int] = ()
) -> None:
    """Plot the cameras' frusta and names, the points and the world axes, in world units.

    Up is the mean of the cameras' up directions, forward the mean of their viewing directions. The left half is seen
    from above with forward to the top, the right half from the right with forward to the right.

    Args:
        figure: an empty figure or subfigure of matplotlib.
        cameras: the rig.
        points: positions [P, 3] in world units and colours [P, 3] in [0, 1]; distant ones are cut off.
        test_views: indices of the held-out cameras, drawn in red.
    """
    right, forward, up = _directions(cameras)
    positions = np.array([camera.position for camera in cameras])
    middle = positions.mean(0)
    radius = np.linalg.norm(positions - middle, axis=1).max() or 1.0
    places, colors = (values[:: max(1, len(values) // _MAX_POINTS)] for values in points)
    frusta = np.array([_frustum(camera, 0.25 * radius) for camera in cameras]) - middle
    near = np.linalg.norm(places - middle, axis=1) < 8 * radius
    places, colors = places[near] - middle, np.clip(colors[near], 0, 1)
    core = np.percentile(places, [1, 99], axis=0) if len(places) else np.zeros((0, 3))
    box = np.concatenate([frusta.reshape(-1, 3), core])
    planes = {
        "From above": ("right", "forward", np.stack([right, forward])),
        "From the right": ("forward", "up", np.stack([forward, up])),
    }
    for axes, (title, (across, upwards, plane)) in zip(figure.subplots(1, 2), planes.items(), strict=True):
        axes.set(title=title, xlabel=f"{across}, world units", ylabel=f"{upwards}, world units")
        axes.scatter(*(plane @ places.T), s=1, c=colors, rasterized=True)
        for index, (camera, frustum) in enumerate(zip(cameras, frusta @ plane.T, strict=True)):
            color = _HELD_OUT if index in test_views else _TRAINING
            axes.plot(*frustum[_EDGES].T, color=color, linewidth=1)
            axes.plot(*frustum[0], "o", color=color, markersize=4)
            name = camera.name or str(index)
            axes.annotate(name, frustum[0], xytext=(4, 4), textcoords="offset points", fontsize=8)
        _frame(axes, box @ plane.T)
        _draw_axes(axes, plane)


def _directions(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rig's right, forward and up [3, 3], orthonormal."""
    axes = np.array([np.asarray(camera.viewmat, np.float64)[:3, :3] for camera in cameras])
    up = -axes[:, 1].mean(0)
    # Cameras all around a scene have no common forward direction: use the first camera's direction.
    forward = axes[:, 2].mean(0)
    up = up if np.linalg.norm(up) > 1e-3 else -axes[0, 1]
    up = up / np.linalg.norm(up)
    forward = forward - up * (forward @ up)
    if np.linalg.norm(forward) < 1e-3:
        forward = axes[0, 2] - up * (axes[0, 2] @ up)
    if np.linalg.norm(forward) < 1e-3:
        forward = np.cross(up, axes[0, 0])
    forward = forward / np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up])


def _frustum(camera: Camera, depth: float) -> np.ndarray:
    """Return the camera's centre and the four corners of its image at `depth` [5, 3], world units."""
    w, h = camera.width, camera.height
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    return np.vstack([camera.position, camera.unproject(corners, np.full(4, depth))])


def _frame(axes: Any, box: np.ndarray) -> None:
    """Show the square that contains the points `box` [n, 2], at one scale along both axes."""
    middle, half = (box.min(0) + box.max(0)) / 2, 0.6 * max(np.ptp(box, axis=0).max(), 1e-12)
    axes.set(xlim=middle[0] + (-half, half), ylim=middle[1] + (-half, half), aspect="equal")
    axes.grid(color="0.9")
    axes.set_axisbelow(True)


def _draw_axes(axes: Any, plane: np.ndarray) -> None:
    """Draw the directions of the world axes in the lower left corner."""
    for (name, color), direction in zip(_AXES, plane.T, strict=True):
        if np.linalg.norm(direction) > 0.4:
            axes.annotate(
                name,
                (0.12, 0.12),
                xycoords="axes fraction",
                xytext=36 * direction,
                textcoords="offset points",
                color=color,
                ha="center",
                va="center",
                arrowprops={"arrowstyle": "<-", "color": color},
            )

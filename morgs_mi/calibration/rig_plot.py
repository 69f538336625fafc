"""Plot of the rig: cameras and points seen from above and from the side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
from morgs_mi.core.files import atomic_path

__all__ = ["draw_rig", "write_rig"]

_PANEL, _MARGIN, _HEAD = 720, 60, 40
_INK, _GREY, _HELD_OUT, _TRAINING = (40, 40, 40), (150, 150, 150), (210, 60, 40), (40, 90, 190)
_AXES = (("x", (200, 40, 40)), ("y", (40, 150, 40)), ("z", (40, 60, 210)))
_MAX_POINTS = 20_000
Projection = Callable[[np.ndarray], np.ndarray]


def write_rig(path: Path, capture: Capture, *below: np.ndarray) -> None:
    """Write the plot of a capture's rig as .png or .jpg; the file appears whole or not at all.

    Args:
        path: the file.
        capture: the capture.
        below: plots of the same width that are appended below.

    Raises:
        ValueError: the name has another suffix.
        OSError: the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"{path}: the suffix of a plot must be .png or .jpg, got {suffix!r}; rename it.")
    image = draw_rig(capture.cameras, capture.points, capture.point_colors, capture.test_view)
    image = np.concatenate([image, *below])
    data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
    with atomic_path(path, "write_rig()") as partial:
        partial.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data)


def draw_rig(
    cameras: Sequence[Camera], points: np.ndarray, point_colors: np.ndarray, test_view: int | None = None
) -> np.ndarray:
    """Return a plot of the cameras' frusta and names, the points, the world axes and a scale: RGB uint8 [H, W, 3].

    Up is the mean of the cameras' up directions, forward the mean of their viewing directions. The left half is seen
    from above with forward to the top, the right half from the right with forward to the right.

    Args:
        cameras: the rig.
        points: [P, 3] world units; distant ones are cut off.
        point_colors: [P, 3] in [0, 1].
        test_view: index of the held-out camera, drawn in red.
    """
    frame = _directions(cameras)
    positions = np.array([camera.position for camera in cameras])
    middle = positions.mean(0)
    radius = np.linalg.norm(positions - middle, axis=1).max() or 1.0
    near = np.linalg.norm(points - middle, axis=1) < 8 * radius
    points, point_colors = points[near], point_colors[near]
    step = max(1, len(points) // _MAX_POINTS)
    points, point_colors = points[::step], point_colors[::step]
    corners = np.array([_frustum(camera, 0.25 * radius) for camera in cameras])
    core = np.percentile(points, [1, 99], axis=0) if len(points) else np.zeros((0, 3))
    box = np.concatenate([corners.reshape(-1, 3), core])
    panels = []
    for title, across, up in (("from above", frame[0], frame[1]), ("from the right", frame[1], frame[2])):
        panel = np.full((_PANEL + _HEAD, _PANEL, 3), 255, np.uint8)
        project, scale = _projection(box, np.stack([across, up]))
        for (x, y), color in zip(project(points), (255 * np.clip(point_colors, 0, 1)).astype(int), strict=True):
            cv2.circle(panel, (x, y), 1, color.tolist(), -1)
        _draw_cameras(panel, cameras, corners, project, test_view)
        _draw_axes(panel, np.stack([across, up]))
        _draw_scale(panel, scale)
        cv2.putText(panel, title, (_MARGIN, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _INK, 1, cv2.LINE_AA)
        panels.append(panel)
    return np.concatenate(panels, axis=1)


def _directions(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rig's right, forward and up [3, 3], orthonormal."""
    axes = np.array([np.asarray(camera.viewmat, np.float64)[:3, :3] for camera in cameras])
    up = -axes[:, 1].mean(0)
    # Cameras all around a scene have no common forward direction: use that of the first one.
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


def _projection(box: np.ndarray, plane: np.ndarray) -> tuple[Projection, float]:
    """Return the function from points [n, 3] to pixels [n, 2] of a panel that contains `box`, and its px per unit."""
    flat = box @ plane.T
    low, high = flat.min(0), flat.max(0)
    scale = (_PANEL - 2 * _MARGIN) / max((high - low).max(), 1e-12)
    middle = (low + high) / 2

    def project(points: np.ndarray) -> np.ndarray:
        flat = (points @ plane.T - middle) * scale
        pixels = np.stack([_PANEL / 2 + flat[:, 0], _HEAD + _PANEL / 2 - flat[:, 1]], axis=1)
        return np.rint(np.clip(pixels, -1e4, 1e4)).astype(int)

    return project, scale


def _draw_cameras(
    panel: np.ndarray, cameras: Sequence[Camera], corners: np.ndarray, project: Projection, test_view: int | None
) -> None:
    for index, (camera, frustum) in enumerate(zip(cameras, corners, strict=True)):
        color = _HELD_OUT if index == test_view else _TRAINING
        centre, *ends = (tuple(map(int, p)) for p in project(frustum))
        for a, b in zip(ends, ends[1:] + ends[:1], strict=True):
            cv2.line(panel, centre, a, color, 1, cv2.LINE_AA)
            cv2.line(panel, a, b, color, 1, cv2.LINE_AA)
        cv2.circle(panel, centre, 3, color, -1, cv2.LINE_AA)
        label = camera.name or str(index)
        cv2.putText(panel, label, (centre[0] + 6, centre[1] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _INK, 1, cv2.LINE_AA)


def _draw_axes(panel: np.ndarray, plane: np.ndarray) -> None:
    """Draw the directions of the world axes, 40 px long, in the lower left corner."""
    start = np.array([_MARGIN, panel.shape[0] - _MARGIN])
    for (name, color), axis in zip(_AXES, plane.T, strict=True):
        end = start + np.rint(40 * axis * (1, -1)).astype(int)
        cv2.arrowedLine(panel, start.tolist(), end.tolist(), color, 2, cv2.LINE_AA, tipLength=0.2)
        if np.linalg.norm(axis) > 0.2:
            place = (end + np.rint(12 * axis * (1, -1)).astype(int) + (-4, 4)).tolist()
            cv2.putText(panel, name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv2.LINE_AA)


def _draw_scale(panel: np.ndarray, scale: float) -> None:
    """Draw a bar of a round number of world units, about a quarter of the panel."""
    wanted = 0.25 * _PANEL / scale
    power = 10.0 ** np.floor(np.log10(wanted))
    length = power * max(step for step in (1, 2, 5) if step * power <= wanted)
    right, y = _PANEL - _MARGIN, panel.shape[0] - _MARGIN // 2
    cv2.line(panel, (round(right - length * scale), y), (right, y), _INK, 2)
    text = f"{length:g} world unit{'' if length == 1 else 's'}"
    cv2.putText(panel, text, (right - 130, y - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)

"""Cameras that move: key views joined by splines, and the paths that a rig suggests.

A path has K key views at rising times in seconds. Between them the position follows a cubic spline, the rotation a
rotation spline (both with continuous acceleration), focal lengths and principal point a cubic spline in pixels.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from morgs_mi.core.camera import Camera, rigid
from morgs_mi.export.axes import up_direction

__all__ = ["CameraPath", "between", "focus", "load_path", "orbit"]

# Of the world's spread: how strongly the Gaussians' middle pulls where the optical axes meet nowhere.
_PULL = 0.01


@dataclass(frozen=True)
class CameraPath:
    """A camera that moves through key views.

    Attributes:
        times: seconds [K], rising, the first 0.
        keys: the K views, all of one size.

    Raises:
        ValueError: fewer than two keys, times that do not rise from 0, or sizes that differ.
    """

    times: np.ndarray
    keys: tuple[Camera, ...]

    def __post_init__(self) -> None:
        times = np.asarray(self.times, np.float64)
        object.__setattr__(self, "times", times)
        if len(self.keys) < 2 or times.shape != (len(self.keys),):
            raise ValueError(
                f"CameraPath(): at least two key views with a time each were expected, got {len(self.keys)} views and "
                f"{times.size} times."
            )
        if times[0] != 0 or not np.all(np.diff(times) > 0):
            raise ValueError(f"CameraPath(): `times` must rise from 0, got {times.tolist()}.")
        sizes = {(key.width, key.height) for key in self.keys}
        if len(sizes) > 1:
            raise ValueError(f"CameraPath(): `keys` must be of one size, got {sorted(sizes)}; resize them.")

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return float(self.times[-1])

    def at(self, time: float) -> Camera:
        """Return the view at a time in seconds, held still before the first key and after the last."""
        time = float(np.clip(time, 0, self.seconds))
        places, turns, lenses = self._splines
        R = turns(time).as_matrix().T
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ places(time)
        log_fx, log_fy, cx, cy = lenses(time)
        K = np.array([[np.exp(log_fx), 0, cx], [0, np.exp(log_fy), cy], [0, 0, 1]])
        return replace(self.keys[0], K=K, viewmat=viewmat, name="path")

    def lasting(self, seconds: float) -> CameraPath:
        """Return the same path at another speed, so that it takes `seconds`.

        Raises:
            ValueError: it is not a positive time.
        """
        if not (np.isfinite(seconds) and seconds > 0):
            raise ValueError(f"CameraPath.lasting(): `seconds` must be positive, got {seconds}.")
        return replace(self, times=self.times * (seconds / self.seconds))

    @cached_property
    def _splines(self) -> tuple[CubicSpline, RotationSpline, CubicSpline]:
        K = np.stack([key.K for key in self.keys])
        # Logarithms keep focal lengths positive where a spline overshoots.
        lenses = np.stack([np.log(K[:, 0, 0]), np.log(K[:, 1, 1]), K[:, 0, 2], K[:, 1, 2]], axis=1)
        turns = Rotation.from_matrix(np.stack([np.asarray(key.viewmat, np.float64)[:3, :3].T for key in self.keys]))
        places = np.stack([key.position for key in self.keys])
        return CubicSpline(self.times, places), RotationSpline(self.times, turns), CubicSpline(self.times, lenses)


def focus(cameras: Sequence[Camera], means: np.ndarray) -> np.ndarray:
    """Return the point [3] that the rig looks at: nearest to all optical axes.

    Parallel axes meet nowhere, so the middle of the Gaussians' centres [N, 3] pulls a little: it decides the distance.
    """
    middle = np.median(means, axis=0)
    A, b = _PULL * len(cameras) * np.eye(3), _PULL * len(cameras) * middle
    for camera in cameras:
        axis = np.asarray(camera.viewmat, np.float64)[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        A, b = A + across, b + across @ camera.position
    return np.linalg.solve(A, b)


def orbit(
    cameras: Sequence[Camera], center: np.ndarray, degrees: float | None = None, seconds: float = 1
) -> CameraPath:
    """Return the way of the first camera around the upright axis through `center` [3], looking there.

    Less than 360 degrees are a swing, half of it to either side. By default it is as wide as the rig, and all the way
    round where the rig is.

    Raises:
        ValueError: the camera is at the centre or right above it, or `degrees` is not 1 to 360.
    """
    first, up = cameras[0], up_direction(cameras)
    arm = first.position - center
    if np.linalg.norm(np.cross(arm, up)) < 1e-3 * np.linalg.norm(arm) or not arm.any():
        raise ValueError(
            f"orbit(): the camera {first.name!r} must stand beside the scene, got it right above; use another path."
        )
    degrees = _width(cameras, center, up) if degrees is None else degrees
    if not 1 <= degrees <= 360:
        raise ValueError(f"orbit(): `degrees` must be 1 to 360, got {degrees:g}.")
    start = 0 if degrees == 360 else -degrees / 2
    angles = np.linspace(start, start + degrees, max(5, round(degrees / 10) + 1))
    places = center + Rotation.from_rotvec(np.deg2rad(angles)[:, None] * up).apply(arm)
    keys = tuple(_looking(place, center, up, first) for place in places)
    return CameraPath(np.linspace(0, seconds, len(keys)), keys)


def between(cameras: Sequence[Camera], seconds: float = 1) -> CameraPath:
    """Return the way through all cameras at an even pace, each resized to the first: from that one to the nearest next.

    Raises:
        ValueError: fewer than two cameras.
    """
    left = [camera.resized(cameras[0].width, cameras[0].height) for camera in cameras]
    keys = [left.pop(0)]
    while left:
        far = [np.linalg.norm(camera.position - keys[-1].position) for camera in left]
        keys.append(left.pop(int(np.argmin(far))))
    steps = np.linalg.norm(np.diff([key.position for key in keys], axis=0), axis=-1) if len(keys) > 1 else np.zeros(0)
    # Cameras at one place, which only turn, take their time too.
    steps = np.maximum(steps, 0.1 * steps.mean() if steps.any() else 1)
    return CameraPath(np.concatenate([[0], np.cumsum(steps)]), tuple(keys)).lasting(seconds)


def load_path(file: str | Path, cameras: Sequence[Camera]) -> CameraPath:
    """Read a path from JSON: an object with `keys` and, for all of them, `width`, `height`, `fov_x`, `up`.

    A key has a `time` in seconds and one of `camera` (a name of the rig), `viewmat` (world to camera, OpenCV's axes,
    4x4) and `position` with `target`; the last two may have their own `fov_x` in degrees across and `up`. What is not
    said is as in the rig: its first camera's size and lens, its mean up.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not JSON, or a key is not as described.
    """
    if not Path(file).is_file():
        raise FileNotFoundError(f"{file}: expected a camera path, found none; check the path.")
    try:
        told = json.loads(Path(file).read_text(encoding="utf-8"))
        keys = [dict(key) for key in told["keys"]]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{file}: expected a JSON object with a list `keys` of objects, got {error!r}.") from None
    common = {name: value for name, value in told.items() if name != "keys"}
    views, times = [], []
    for i, key in enumerate(keys):
        try:
            times.append(float(key["time"]))
            views.append(_view({**common, **key}, cameras))
        except KeyError as error:
            raise ValueError(f"{file}: key {i}: {error.args[0]!r} is missing.") from None
        except (ValueError, TypeError) as error:
            raise ValueError(f"{file}: key {i}: {error}") from None
    try:
        return CameraPath(np.asarray(times), tuple(views))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def _view(key: Mapping[str, Any], cameras: Sequence[Camera]) -> Camera:
    first = cameras[0]
    like = first.resized(int(key.get("width", first.width)), int(key.get("height", first.height)))
    if "camera" in key:
        named = {camera.name: camera for camera in cameras}
        if key["camera"] not in named:
            raise ValueError(f"`camera` must be one of {', '.join(named)}, got {key['camera']!r}.")
        return named[key["camera"]].resized(like.width, like.height)
    if "fov_x" in key:
        f = 0.5 * like.width / np.tan(np.deg2rad(0.5 * float(key["fov_x"])))
        like = replace(like, K=np.array([[f, 0, 0.5 * like.width], [0, f, 0.5 * like.height], [0, 0, 1]]))
    if "viewmat" in key:
        return replace(like, viewmat=rigid("`viewmat`", np.asarray(key["viewmat"], np.float64)))
    place, target = (np.asarray(key[name], np.float64) for name in ("position", "target"))
    up = np.asarray(key["up"], np.float64) if "up" in key else up_direction(cameras)
    if any(v.shape != (3,) for v in (place, target, up)) or not np.cross(target - place, up).any():
        raise ValueError("`position`, `target` and `up` must have 3 numbers each, and the view must not be along `up`.")
    return _looking(place, target, up, like)


def _width(cameras: Sequence[Camera], center: np.ndarray, up: np.ndarray) -> float:
    """Return how many degrees around the upright axis the rig takes, 10 at least; 360 without a gap of 90."""
    arms = np.stack([camera.position - center for camera in cameras])
    level = arms[0] - (arms[0] @ up) * up
    angles = np.sort(np.rad2deg(np.arctan2(arms @ np.cross(up, level), arms @ level)))
    gap = np.diff(angles, append=angles[0] + 360).max()
    return 360 if gap < 90 else max(10, 360 - gap)


def _looking(place: np.ndarray, target: np.ndarray, up: np.ndarray, like: Camera) -> Camera:
    """Return the view from a place to a target with the lens of another camera."""
    view = Camera.look_at(place, target, up, 60, like.width, like.height).viewmat
    return replace(like, viewmat=view, name="path")

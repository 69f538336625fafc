"""Camera paths: splines through key views, and paths that are derived from a rig.

A path has K key views at increasing times in seconds. Between them the position follows a cubic
spline, the rotation a rotation spline (both with continuous acceleration), the focal lengths and
the principal point a cubic spline in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from reprlib import repr as shortened
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

from morgs_mi.core.camera import (
    Camera,
    intrinsic_matrix,
    intrinsics_of_fov,
    pose_at,
    rigid,
)
from morgs_mi.core.rig import focus_point, positions_of, up_direction
from morgs_mi.io.listing import existing_file
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.checks import check_number, require

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

# Weight of the Gaussians' median relative to an optical axis; it matters only where the axes do not
# meet.
_MEDIAN_WEIGHT = 0.01


@dataclass(frozen=True)
class CameraPath:
    """A camera that moves through key views.

    Raises:
        ValueError: fewer than two keys, times that do not increase from 0, or different sizes.
    """

    times: np.ndarray  #: Seconds [K], increasing from 0.
    keys: tuple[Camera, ...]  #: The K views, all of the same image size.

    def __post_init__(self) -> None:
        times = np.asarray(self.times, np.float64)
        object.__setattr__(self, "times", times)
        sizes = {key.size for key in self.keys}
        require(
            times.shape == (len(self.keys),)
            and len(self.keys) > 1
            and len(sizes) == 1
            and times[0] == 0
            and np.all(np.diff(times) > 0),
            "CameraPath()",
            "expected at least two key views of one size, with `times` that increase from 0",
            f"{len(self.keys)} views of {sorted(sizes)} at {times.tolist()}",
            "correct the keys",
        )

    @property
    def seconds(self) -> float:
        """Duration of the path."""
        return float(self.times[-1])

    def with_width(self, width: int) -> CameraPath:
        """Return the same path with images of another width and the same aspect ratio.

        Raises:
            ValueError: `width` is below 1.
        """
        return replace(self, keys=tuple(key.with_width(width) for key in self.keys))

    def at(self, time: float) -> Camera:
        """Return the view at a time in seconds: the nearest key outside of all keys."""
        time = float(np.clip(time, 0, self.seconds))
        positions, rotations, intrinsics = self._splines
        viewmat = pose_at(rotations(time).as_matrix().T, positions(time))
        log_fx, log_fy, cx, cy = intrinsics(time)
        K = intrinsic_matrix(np.exp(log_fx), np.exp(log_fy), cx, cy)
        return replace(self.keys[0], K=K, viewmat=viewmat, name="path")

    def with_duration(self, seconds: float) -> CameraPath:
        """Return the same path at another speed, with a duration of `seconds`.

        Raises:
            ValueError: `seconds` is not positive and finite.
        """
        check_number("CameraPath.with_duration()", "seconds", seconds, "(0, inf)")
        return replace(self, times=self.times * (seconds / self.seconds))

    @cached_property
    def _splines(self) -> tuple[CubicSpline, RotationSpline, CubicSpline]:
        # Not at the start of every command, which it slows down.
        from scipy.interpolate import CubicSpline

        views = [key.rotation.T for key in self.keys]
        K = np.stack([key.K for key in self.keys])
        # With logarithms the focal lengths stay positive where the spline overshoots.
        intrinsics = [np.log(K[:, 0, 0]), np.log(K[:, 1, 1]), K[:, 0, 2], K[:, 1, 2]]
        return (
            CubicSpline(self.times, positions_of(self.keys)),
            RotationSpline(self.times, Rotation.from_matrix(np.stack(views))),
            CubicSpline(self.times, np.stack(intrinsics, axis=1)),
        )


def focus(cameras: Sequence[Camera], means: np.ndarray) -> np.ndarray:
    """Return the point [3] that the rig looks at: the nearest point to all optical axes.

    The median of the Gaussians' centres [N, 3] has a small weight; it determines the distance of
    parallel axes.
    """
    return focus_point(cameras, np.median(means, axis=0), _MEDIAN_WEIGHT * len(cameras))


def orbit(
    cameras: Sequence[Camera], center: np.ndarray, degrees: float | None = None, seconds: float = 1
) -> CameraPath:
    """Return the path of the first camera around the vertical axis through `center` [3], looking at
    `center`.

    An orbit of less than 360 degrees extends by half of it to either side. By default it is as wide
    as the rig, and a full circle if the rig surrounds the scene.

    Raises:
        ValueError: the camera is at the centre or directly above it, or `degrees` is not in 1..360.
    """
    first = cameras[0]
    up = up_direction(cameras)
    arm = first.position - center
    if np.linalg.norm(np.cross(arm, up)) <= 1e-3 * np.linalg.norm(arm):
        raise ValueError(
            f"orbit(): the camera {first.name!r} must stand beside the scene; use another path."
        )
    if degrees is None:
        # The angle that the rig covers around the vertical.
        arms = positions_of(cameras) - center
        level = arms[0] - (arms[0] @ up) * up
        bearings = np.sort(np.rad2deg(np.arctan2(arms @ np.cross(up, level), arms @ level)))
        gap = np.diff(bearings, append=bearings[0] + 360).max()
        degrees = 360 if gap < 90 else max(10, 360 - gap)
    check_number("orbit()", "degrees", degrees, "[1, 360]")
    start = 0 if degrees == 360 else -degrees / 2
    # The key views are about 10 degrees apart.
    angles = np.linspace(start, start + degrees, max(5, round(degrees / 10) + 1))
    positions = center + Rotation.from_rotvec(np.deg2rad(angles)[:, None] * up).apply(arm)
    keys = tuple(_look_at(position, center, up, first) for position in positions)
    return CameraPath(np.linspace(0, seconds, len(keys)), keys)


def through_cameras(cameras: Sequence[Camera], seconds: float = 1) -> CameraPath:
    """Return the path through all cameras at constant speed, from the first one always to the
    nearest remaining one.

    All cameras are resized to the first one's image size.

    Raises:
        ValueError: there are fewer than two cameras.
    """
    if len(cameras) < 2:
        raise ValueError("through_cameras(): expected two cameras or more; use the path `orbit`.")
    first, *candidates = [camera.resized(cameras[0].width, cameras[0].height) for camera in cameras]
    keys = [first]
    while candidates:
        distances = [np.linalg.norm(camera.position - keys[-1].position) for camera in candidates]
        keys.append(candidates.pop(int(np.argmin(distances))))
    steps = np.linalg.norm(np.diff([key.position for key in keys], axis=0), axis=-1)
    # A rotation between cameras at the same position takes time too.
    steps = np.maximum(steps, 0.1 * steps.mean() if steps.any() else 1)
    return CameraPath(np.concatenate([[0], np.cumsum(steps)]), tuple(keys)).with_duration(seconds)


def load_path(file: str | Path, first: Camera) -> CameraPath:
    """Read a path from a JSON object with `keys` and, common to all of them, `width`, `height` and
    `fov_x`.

    A key has a `time` in seconds and a `viewmat` (world to camera, OpenCV's axes, 4x4), and may
    have its own `fov_x` (horizontal, degrees). The defaults are the size and intrinsics of `first`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not JSON, or a key is not as described.
    """
    document = read_json(existing_file(file, "a camera path (orbit, between or a JSON file)"))
    place = file
    try:
        views = []
        times = []
        for i, entry in enumerate(document["keys"]):
            place = f"{file}: key {i}"
            key = {**document, **entry}
            times.append(float(key["time"]))
            width = int(key.get("width", first.width))
            height = int(key.get("height", first.height))
            view = first.resized(width, height)
            if "fov_x" in key:
                view = replace(view, K=intrinsics_of_fov(float(key["fov_x"]), width, height))
            viewmat = rigid("`viewmat`", np.asarray(key["viewmat"], np.float64))
            views.append(replace(view, viewmat=viewmat))
        place = file
        return CameraPath(np.asarray(times), tuple(views))
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise ValueError(
            f"{place}: expected a JSON object with a list `keys` of views, got "
            f"{shortened(document)} ({type(error).__name__}: {error}); write a `time` and a "
            "`viewmat` for each of the `keys`."
        ) from None


def _look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray, like: Camera) -> Camera:
    """Return the view from a position to a target with the intrinsics of another camera."""
    view = Camera.look_at(position, target, up, 60, like.width, like.height).viewmat
    return replace(like, viewmat=view, name="path")

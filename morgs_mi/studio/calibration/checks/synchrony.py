"""Time offsets between calibrated cameras, from the changes of their images.

An object lies between the same two epipolar planes of a pair of cameras in both views. The
*epipolar profile* of a view is the change per epipolar plane and frame. The profiles of both views
are similar, but shifted in time by the difference of the cameras' time offsets (after Pundik and
Moses, Video Synchronization Using Temporal Signals from Epipolar Lines, ECCV 2010).

The offsets of `calibration.timing` are more exact. On 12 frames of `spheres` by 7 cameras of 128x96
pixels, which are up to 1.1 frames apart, their largest error is 0.05 frames, here 0.30. But its
fits take minutes instead of half a second, and it finds no offsets beyond 3 frames.

Notation: frame k of camera i shows the time k + o_i, with o_i its time offset in frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.core.camera import Camera
from morgs_mi.studio.calibration.checks.signals import known_median

_PLANES = 48
# Grey levels, and multiples of a frame's median change, below which a change is noise or
# compression.
_NOISE = 6.0
_MEDIANS = 5.0
# Largest shift, in frames and as a share of the clip: fewer overlapping frames correlate by chance.
_MAX_SHIFT = 15
_MAX_SHARE = 0.25
# A pair's peak counts if it is this high, and higher by this much than three frames beside it.
_MIN_CORRELATION = 0.3
_MIN_PROMINENCE = 0.05
_BESIDE = 3
# Difference in frames up to which a pair agrees with the offsets of its cameras, and the share of a
# camera's pairs that must agree.
_AGREEING = 0.5
_MIN_AGREEMENT = 0.75
_ITERATIONS = 30


def time_offsets(cameras: Sequence[Camera], thumbs: Sequence[np.ndarray]) -> np.ndarray:
    """Return the time offset of each camera from the others' median [C], frames; NaN where it is
    not determined.

    An offset is determined if three quarters of the camera's pairs with others agree about it. It
    is accurate to 0.4 frames where objects hardly move across the epipolar planes (see `timing` for
    fractions of frames).

    Args:
        cameras: C views.
        thumbs: per camera thumbnails [T, h, w] of the same instants, values in [0, 255], NaN where
            missing.
    """
    *pairs, frames, weights = np.reshape(list(_pair_shifts(cameras, thumbs)), (-1, 4)).T
    views = np.stack(pairs, axis=1).astype(int)
    offsets = consensus(len(cameras), views, frames, weights)
    return np.where(_are_determined(offsets, views, frames), offsets, np.nan)


def _are_determined(offsets: np.ndarray, views: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the mask of the offsets [C] with which enough pairs [P, 2] of their cameras agree."""
    of_camera = (views[:, :, None] == np.arange(len(offsets))).any(axis=1)
    count = (of_camera & _agree(offsets, views, frames)[:, None]).sum(axis=0)
    return count >= _MIN_AGREEMENT * of_camera.sum(axis=0)


def _agree(offsets: np.ndarray, views: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the mask of the pairs [P, 2] whose difference [P] agrees with the offsets [C]."""
    return np.abs(offsets[views[:, 1]] - offsets[views[:, 0]] - frames) <= _AGREEING


def consensus(
    count: int, views: ArrayLike, differences: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return values x [count] that best explain differences x_j - x_i [P] of pairs (i, j) [P, 2],
    by weighted L1.

    The median of x, or the lower one of two, is zero; x is NaN for an index in no pair.
    """
    values = np.full(count, np.nan)
    pairs = np.reshape(views, (-1, 2)).astype(int)
    if len(pairs):
        members = np.unique(pairs)
        x = _least_deviations(_difference_matrix(count, pairs), differences, weights)[members]
        values[members] = x - np.quantile(x, 0.5, method="lower")
    return values


def _difference_matrix(count: int, pairs: np.ndarray) -> np.ndarray:
    """Return the matrix [P, count] that turns values x into x_j - x_i of pairs (i, j) [P, 2]."""
    unit = np.eye(count)
    return unit[pairs[:, 1]] - unit[pairs[:, 0]]


def _least_deviations(A: np.ndarray, b: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the x with the least weighted sum of |A x - b|, by iteratively reweighted least
    squares.
    """
    scale = np.sqrt(weights)
    for _ in range(_ITERATIONS):
        x = np.linalg.lstsq(A * scale[:, None], b * scale, rcond=None)[0]
        scale = np.sqrt(weights / np.maximum(np.abs(A @ x - b), 1e-2))
    return x


def _pair_shifts(
    cameras: Sequence[Camera], thumbs: Sequence[np.ndarray]
) -> Iterator[tuple[int, int, float, float]]:
    """Yield i, j, o_j - o_i and a weight for each pair of cameras with distinct common motion."""
    changes = [_changes(frames) for frames in thumbs]
    rays = [_rays(camera, frames.shape[1:]) for camera, frames in zip(cameras, thumbs, strict=True)]
    for i, j in combinations(range(len(cameras)), 2):
        angles = _plane_angles(cameras[i], cameras[j], rays[i], rays[j])
        if profiles := _profiles((changes[i], changes[j]), angles):
            frames, weight = _best_shift(*profiles)
            if weight >= _MIN_PROMINENCE:
                yield i, j, frames, weight


def _changes(thumbs: np.ndarray) -> np.ndarray:
    """Return the change of each pixel from frame to frame above the noise [T - 1, h * w]."""
    frames = _with_one_level(thumbs.reshape(len(thumbs), -1))
    steps = np.nan_to_num(np.abs(np.diff(frames, axis=0)))
    return np.maximum(steps - _noise(steps), 0)


def _noise(steps: np.ndarray) -> np.ndarray:
    """Return the change of a pixel [T - 1, 1] below which it is noise or compression."""
    return np.maximum(_NOISE, _MEDIANS * np.median(steps, axis=1, keepdims=True))


def _with_one_level(frames: np.ndarray) -> np.ndarray:
    """Return frames [T, h * w] scaled to one median: a change of the exposure is no motion."""
    level = known_median(frames, axis=1)[:, None]
    return frames * (known_median(level, axis=0) / np.maximum(level, 1))


def _rays(camera: Camera, shape: tuple[int, ...]) -> np.ndarray:
    """Return the directions of a thumbnail's pixels [h * w, 3]."""
    height, width = shape
    return camera.resized(width, height).rays(_pixel_centres(width, height))[1]


def _pixel_centres(width: int, height: int) -> np.ndarray:
    """Return the positions of the centres of an image's pixels [h * w, 2], row by row."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def _plane_angles(a: Camera, b: Camera, *rays: np.ndarray) -> list[np.ndarray]:
    """Return the angle of the epipolar half plane of each ray about the baseline of two cameras,
    radians.
    """
    baseline = _unit(b.position - a.position)
    forward = sum(np.asarray(camera.viewmat, np.float64)[2, :3] for camera in (a, b))
    across = _unit(forward - baseline * (baseline @ forward))
    return [np.arctan2(r @ np.cross(baseline, across), r @ across) for r in rays]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _profiles(
    changes: tuple[np.ndarray, np.ndarray], angles: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the epipolar profiles of two views on the planes that both see; none without such
    planes.
    """
    low, high = _common_range(angles)
    if not high > low:
        return []
    return [_profile(*view, low, high) for view in zip(changes, angles, strict=True)]


def _common_range(angles: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the range of angles that each view has, without the outermost ones."""
    return max(np.percentile(a, 2) for a in angles), min(np.percentile(a, 98) for a in angles)


def _profile(changes: np.ndarray, angles: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the epipolar profile [T - 1, planes], relative to the mean over time and over the
    planes.
    """
    planes = np.floor((angles - low) / (high - low) * _PLANES).astype(int)
    mask = (planes >= 0) & (planes < _PLANES)
    sum_of = partial(np.bincount, planes[mask], minlength=_PLANES)
    sums = [sum_of(change[mask]) for change in changes]
    return np.sqrt(np.array(sums).reshape(len(changes), _PLANES) / np.maximum(sum_of(), 1))


def _best_shift(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the shift of the largest correlation, between frames by a parabola, and its height
    above other shifts.

    The height is zero if the correlation is low, or largest at the longest shift, or if the clip is
    short.
    """
    largest = min(_MAX_SHIFT, int(_MAX_SHARE * len(a)))
    if largest < 2:
        return 0.0, 0.0
    curve = np.array([_shifted_correlation(a, b, s) for s in range(-largest, largest + 1)])
    k = int(curve.argmax())
    if k in (0, len(curve) - 1) or curve[k] < _MIN_CORRELATION:
        return 0.0, 0.0
    return k - largest + _vertex(*curve[k - 1 : k + 2]), _prominence(curve, k)


def _vertex(left: float, top: float, right: float) -> float:
    """Return the place of the vertex of a parabola through values at -1, 0 and 1."""
    return float(0.5 * (left - right) / (left - 2 * top + right))


def _prominence(curve: np.ndarray, k: int) -> float:
    """Return the height of a curve at k above the larger one of two values beside it."""
    beside = max(curve[max(0, k - _BESIDE)], curve[min(len(curve) - 1, k + _BESIDE)])
    return float(curve[k] - beside)


def _shifted_correlation(a: np.ndarray, b: np.ndarray, shift: int) -> float:
    """Return the correlation of frame k + shift of a with frame k of b, over all such frames."""
    return _correlation(
        a[max(0, shift) : len(a) + min(0, shift)], b[max(0, -shift) : len(b) - max(0, shift)]
    )


def _correlation(*profiles: np.ndarray) -> float:
    a, b = map(_centred, profiles)
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-9))


def _centred(profile: np.ndarray) -> np.ndarray:
    """Return a profile without the means of its rows and columns."""
    columns = profile.mean(axis=0)
    return profile - columns - profile.mean(axis=1, keepdims=True) + profile.mean()

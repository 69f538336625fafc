"""Bundle adjustment: changes of calibrated cameras, and points, that agree best with matched
features.

A point X lies at x = exp([w]) R (X - C - d) in the axes of a camera with the rotation R and the
centre C, and at the pixel

    u = (1 + s) f (1 + k1 r^2 + k2 r^4) x / z + c + p W ,    r = |(x, y)| / z .

The change of a camera has eleven numbers: a small rotation w [3], a displacement d [3] of its
centre, the relative change s of its focal lengths, the displacement p [2] of its principal point in
image widths W, and the radial distortion k [2] left in its images. They have independent normal
priors around zero.

Images do not determine a common similarity of cameras and points. They hardly determine a common
change of the focal lengths, which depths compensate. With the priors alone, all cameras would turn
together, relative to the cameras that are not adjusted, where a rotation costs less than
displacements. Constraints therefore fix the gauge: changes have no common part. The mean of s is
zero. The shifts of pixels that changes cause for fixed points are orthogonal to the shifts by any
similarity of the points, to first order and in the metric of the equations.

Reprojection errors have Cauchy's loss in units of their own scale, so wrong matches have little
influence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from morgs_mi.core.camera import Camera, pose_at
from morgs_mi.fit.features import FeatureTracks, intersect
from morgs_mi.fit.fit_config import CameraPriors

# Number of parameters of a camera's change.
CHANGES = 11
# Steps, and the relative decrease of the loss below which they end.
_STEPS = 60
_LEAST_DECREASE = 1e-6
# Initial and largest damping of Levenberg and Marquardt.
_DAMPING = 1e-3
_MOST_DAMPING = 1e6
# px, least scale of the reprojection errors of cameras with errors as large as the priors.
_LARGE_ERROR = 1.7
# px, the least scale of the reprojection errors. Cauchy's loss halves the weight of an error of 2.4
# deviations.
_LEAST_SCALE = 0.05
# Standard deviation of the principal point along each axis, in image widths. It follows the
# calibration closely, because its displacement is nearly indistinguishable from a rotation.
_PRINCIPAL_POINT = 2e-4
_CAUCHY = 2.4


class _Estimate(NamedTuple):
    """Estimate of the cameras and points, and its errors."""

    changes: np.ndarray  # of the cameras [V, 11]
    points: np.ndarray  # [P, 3], world units
    errors: np.ndarray  # projections minus the features [n, 2], px


def bundle_adjust(
    cameras: Sequence[Camera], tracks: FeatureTracks, deviations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the changes [V, 11] of the cameras, and the points [P, 3] in world units, that fit the
    tracks best.

    Args:
        cameras: V views as calibrated.
        tracks: features of P > 0 points, each with at most one in a view.
        deviations: standard deviations of the priors of a camera's changes [11], as from
            `likely_deviations`.
    """
    damping = _DAMPING
    estimate = _initial_estimate(cameras, tracks)
    scale = _scale(estimate.errors)
    loss = _loss(estimate, scale, deviations)
    frame = _equations(cameras, tracks, estimate, scale).frame(estimate.points)
    for _ in range(_STEPS):
        equations = _equations(cameras, tracks, estimate, scale)
        of_changes, of_points = equations.step(estimate.changes, deviations, damping, frame)
        trial = _estimate(
            cameras, tracks, estimate.changes + of_changes, estimate.points + of_points
        )
        trial_loss = _loss(trial, scale, deviations)
        if trial_loss < loss:
            estimate = trial
            damping = damping / 10
            if loss - trial_loss < _LEAST_DECREASE * loss:
                break
            scale = min(scale, _scale(estimate.errors))
            loss = _loss(estimate, scale, deviations)
        else:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
    return estimate.changes, estimate.points


def _initial_estimate(cameras: Sequence[Camera], tracks: FeatureTracks) -> _Estimate:
    """Return the estimate without changes of the cameras."""
    points = intersect(tracks.ids, tracks.views, tracks.pixels, cameras, tracks.count)
    return _estimate(cameras, tracks, np.zeros((len(cameras), CHANGES)), points)


def _estimate(
    cameras: Sequence[Camera], tracks: FeatureTracks, changes: np.ndarray, points: np.ndarray
) -> _Estimate:
    """Return the estimate with the errors of its projections, which are large behind a camera."""
    errors = np.empty_like(tracks.pixels)
    depths = np.empty(len(tracks.ids))
    with np.errstate(divide="ignore", invalid="ignore"):
        for rows, camera, change in _changed_views(cameras, changes, tracks):
            pixels, depths[rows] = camera.project(points[tracks.ids[rows]])
            errors[rows] = distorted(camera, pixels, change[9:])
        errors -= tracks.pixels
    errors = np.where((depths[:, None] > 0) & np.isfinite(errors), errors, 1e6)
    return _Estimate(changes, points, errors)


def likely_deviations(
    cameras: Sequence[Camera], tracks: FeatureTracks, deviations: np.ndarray
) -> np.ndarray:
    """Return the deviations [11] of the errors of calibrated cameras, which are small where
    features reproject well.

    Changes that these features do not determine, e.g. a slow bend of the rig, would otherwise
    follow their noise.

    Args:
        cameras: V views as calibrated.
        tracks: features of P > 0 points.
        deviations: standard deviations of the priors [11], the upper bound of the result.
    """
    return deviations * min(1.0, _scale(_initial_estimate(cameras, tracks).errors) / _LARGE_ERROR)


def changed_camera(camera: Camera, changes: np.ndarray) -> Camera:
    """Return a camera with the changes [11] of the module docstring, without the distortion."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + changes[6]
    K[:2, 2] += changes[7:9] * camera.width
    turn = cv2.Rodrigues(np.asarray(changes[:3], np.float64))[0]
    viewmat = pose_at(turn @ camera.rotation, camera.position + changes[3:6])
    return replace(camera, K=K, viewmat=viewmat)


def prior_deviations(extent: float, priors: CameraPriors) -> np.ndarray:
    """Return the standard deviations [11] of the changes of a camera; `extent` is the scene extent,
    world units.
    """
    of_pose = np.deg2rad(priors.rotation), priors.position * extent
    terms = priors.distortion, 0.2 * priors.distortion
    return np.repeat((*of_pose, priors.focal, _PRINCIPAL_POINT, *terms), (3, 3, 1, 2, 1, 1))


def distorted(camera: Camera, pixels: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Return the positions [n, 2] at which radial distortion k [2] shows the pixels [n, 2] of a
    pinhole camera.
    """
    from_centre = pixels - camera.K[:2, 2]
    square = np.sum((from_centre / np.diag(camera.K)[:2]) ** 2, axis=-1, keepdims=True)
    return pixels + from_centre * (distortion[0] + distortion[1] * square) * square


def camera_jacobian(
    camera: Camera, factor: float, points: np.ndarray, distortion: ArrayLike = (0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of pixel positions by the changes of the camera [n, 2, 11] and by the
    points [n, 2, 3].

    The derivative by w is the derivative by a further small rotation, which is equal to first
    order.

    Args:
        camera: camera with the changes so far.
        factor: 1 + s.
        points: [n, 3], world units; the derivatives of points behind the near plane are zero.
        distortion: k [2] so far, of images that are not undistorted by it.
    """
    R = camera.rotation
    x = (points - camera.position) @ R.T
    front = x[:, 2] > camera.near
    of_changes = np.zeros((len(x), 2, CHANGES))
    of_points = np.zeros((len(x), 2, 3))
    if front.any():
        terms = np.append(distortion, (0.0, 0.0))
        # By a rotation and a displacement of the points, f, c and k.
        pose = np.zeros(3)
        J = cv2.projectPoints(x[front], pose, pose, camera.K, terms)[1].reshape(-1, 2, 14)
        of_points[front] = J[:, :, 3:6] @ R
        of_changes[front, :, :3] = J[:, :, :3]
        of_changes[front, :, 6] = J[:, :, 6:8] @ np.diag(camera.K)[:2] / factor
        of_changes[front, :, 7:9] = camera.width * J[:, :, 8:10]
        of_changes[front, :, 9:] = J[:, :, 10:12]
    of_changes[:, :, 3:6] = -of_points
    return of_changes, of_points


class NormalEquations:
    """Normal equations of the changes of V cameras and the displacements of P points.

    An observation that shifts by u contributes u' G u / 2 + b' u to the cost.
    """

    def __init__(self, views: int, points: int) -> None:
        self._cameras = np.zeros((views, CHANGES, CHANGES))
        self._right = np.zeros((views, CHANGES))
        self._points = np.zeros((points, 3, 3))
        self._right_points = np.zeros((points, 3))
        self._coupling = np.zeros((points, views, CHANGES, 3))

    def add(
        self,
        view: int,
        ids: np.ndarray | slice,
        jacobians: tuple[np.ndarray, np.ndarray],
        G: np.ndarray,
        b: np.ndarray,
    ) -> None:
        """Add the observations of n different points in a view.

        Args:
            view: index of the view.
            ids: indices of the points.
            jacobians: as from `camera_jacobian`.
            G: [n, 2, 2].
            b: [n, 2].
        """
        of_camera, of_point = jacobians
        left = of_camera.transpose(0, 2, 1) @ G
        right = of_point.transpose(0, 2, 1) @ G
        self.add_camera(view, of_camera, G, b)
        self._points[ids] += right @ of_point
        self._right_points[ids] += np.einsum("nij,ni->nj", of_point, b)
        self._coupling[ids, view] += left @ of_point

    def add_camera(self, view: int, of_camera: np.ndarray, G: np.ndarray, b: np.ndarray) -> None:
        """Add observations of fixed points; arguments as for `add`."""
        left = of_camera.transpose(0, 2, 1) @ G
        self._cameras[view] += np.tensordot(left, of_camera, axes=((0, 2), (0, 1)))
        self._right[view] += np.einsum("nij,ni->j", of_camera, b)

    def frame(self, points: np.ndarray) -> np.ndarray:
        """Return the constraints of the gauge as rows a [8, V 11]: changes c without a common part
        have a c = 0.

        Args:
            points: [P, 3], world units.
        """
        rows = np.zeros((8, *self._right.shape))
        # Derivatives of the points by a rotation about their mean, a displacement and a factor.
        from_centre = points - points.mean(axis=0)
        shifts = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        turns = -np.cross(np.eye(3), from_centre[:, None])
        similarity = np.concatenate([turns, shifts, from_centre[..., None]], axis=2)
        rows[:7] = np.einsum("pij,pvki->jvk", similarity, self._coupling)
        rows[7, :, 6] = 1
        return rows.reshape(8, -1)

    def step(
        self,
        changes: np.ndarray,
        deviations: np.ndarray,
        damping: float,
        frame: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of Levenberg and Marquardt for cameras [V, 11] and points [P, 3], by
        Schur's complement.

        Args:
            changes: changes of the cameras so far [V, 11].
            deviations: standard deviations of the priors of a camera's changes [11].
            damping: relative increase of the diagonal.
            frame: constraints on the changes after the step [n, V 11], as from `frame`.
        """
        precision = deviations**-2.0
        cameras = _damped(self._cameras + np.diag(precision), damping)
        points = _damped(self._points, damping)
        right = (self._right + precision * changes).ravel()
        coupling = self._coupling.reshape(len(points), right.size, 3)
        solved = coupling @ np.linalg.inv(points)
        by_points = np.tensordot(solved, coupling, axes=((0, 2), (0, 2)))
        matrix = np.asarray(block_diag(*cameras)) - by_points
        right = right - np.einsum("pij,pj->i", solved, self._right_points)
        step = _solved(matrix, -right, frame, -frame @ changes.ravel())
        rest = -self._right_points - np.einsum("pij,i->pj", coupling, step)
        return step.reshape(changes.shape), np.linalg.solve(points, rest[..., None])[..., 0]


def _solved(A: np.ndarray, b: np.ndarray, rows: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the x that minimises x' A x / 2 - b' x with `rows` x = `value`; rows of zeros are
    ignored.
    """
    scale = np.diag(A).mean()
    lengths = np.maximum(np.linalg.norm(rows, axis=1), 1e-30) / scale
    rows = rows / lengths[:, None]
    value = value / lengths
    system = np.block([[A, rows.T], [rows, -1e-9 * scale * np.eye(len(rows))]])
    return np.linalg.solve(system, np.concatenate([b, value]))[: len(b)]


def _damped(blocks: np.ndarray, damping: float) -> np.ndarray:
    """Return blocks [..., k, k] with an increased diagonal, which is above 0 for singular blocks,
    too.
    """
    diagonal = np.einsum("...ii->...i", blocks)
    increase = damping * diagonal + 1e-9 * diagonal.max(axis=-1, keepdims=True) + 1e-30
    return blocks + increase[..., None] * np.eye(blocks.shape[-1])


def _changed_views(
    cameras: Sequence[Camera], changes: np.ndarray, tracks: FeatureTracks
) -> Iterator[tuple[np.ndarray, Camera, np.ndarray]]:
    """Yield the mask of the features of each view, its changed camera, and the change [11]."""
    for view, (camera, change) in enumerate(zip(cameras, changes, strict=True)):
        yield tracks.views == view, changed_camera(camera, change), change


def _equations(
    cameras: Sequence[Camera], tracks: FeatureTracks, estimate: _Estimate, scale: float
) -> NormalEquations:
    """Return the equations of a step of iteratively reweighted least squares, in units of the
    errors' scale.
    """
    changes, points, errors = estimate
    equations = NormalEquations(len(cameras), tracks.count)
    weights = 1 / (scale**2 + (errors**2).sum(axis=1, keepdims=True) / _CAUCHY**2)
    for view, (rows, camera, change) in enumerate(_changed_views(cameras, changes, tracks)):
        ids = tracks.ids[rows]
        jacobians = camera_jacobian(camera, 1 + change[6], points[ids], change[9:])
        w = weights[rows]
        equations.add(view, ids, jacobians, w[..., None] * np.eye(2), w * errors[rows])
    return equations


def _scale(errors: np.ndarray) -> float:
    """Return the standard deviation of the errors along one axis, px."""
    # The median length of a normal error in two dimensions is 1.18 deviations.
    return max(_LEAST_SCALE, float(np.median(np.linalg.norm(errors, axis=1))) / 1.18)


def _loss(estimate: _Estimate, scale: float, deviations: np.ndarray) -> float:
    priors = np.sum((estimate.changes / deviations) ** 2)
    squares = (estimate.errors**2).sum(axis=1) / (_CAUCHY * scale) ** 2
    return float(_CAUCHY**2 * np.log1p(squares).sum() + priors)

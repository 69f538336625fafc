"""Check of the camera poses against feature matches that are found without the poses.

A camera fits if most of its matches with other fitting cameras have a small reprojection error. If
several poses do not fit, the common mistakes of `mistakes` are tried. The check reports the mistake
that explains the matches. Pixels refer to the recorded size, as in `capture.points`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
from morgs_mi.core.view import View
from morgs_mi.extras.calibration.checks.mistakes import (
    focal_candidates,
    rig_candidates,
)
from morgs_mi.fit.features import Match, SharedFeatures, detect, match_views
from morgs_mi.fit.image_points import MAX_ERROR

# With a wrong pose a few matches may fit by chance, but not this many.
_MIN_MATCHES = 50
# A correction must lower the error by this factor: among many candidates, a wrong one may be
# slightly better than the given poses. Poses with an error below this are in the right order and
# axes, px.
_GAIN = 8.0
_GOOD_ERROR = 0.5
# Number of matches of a pair, and of pairs, to compare candidates with: more are slower, but not
# more accurate.
_SAMPLE = 40
_FACTOR_PAIRS = 8
# px. Largest width at which the first frame of a fit is searched for features, in about a second
# for 20 views, and the least one; errors are those at the largest.
_WIDTH = 480
_LEAST_WIDTH = 160
_VERDICTS = {None: "not checked", True: "fits", False: "does not fit"}
_NO_OVERLAP = (
    "check that the clip is of this scene and not mirrored, compare the camera's place in the "
    "plot of the rig (--plot) with the real one, or add cameras in between and textured objects"
)
_WRONG_POSE = (
    "check its place in the order of the cameras, whether its images are turned, its axes and the "
    "image size of the calibration, or calibrate again (morgs-mi calibrate)"
)
_NO_FEATURES = (
    "its first image is black, of one colour or missing: cut such frames off the recording, or "
    "leave the camera out (--exclude)"
)


@dataclass(frozen=True)
class CameraCheck:
    """Result of checking the pose of one camera."""

    name: str  #: Name of the camera.
    matches: int  #: Number of its matches with other cameras.
    #: Median reprojection error of its matches with the cameras that fit, or of all its matches if
    #: there are none, px. NaN without matches, infinite if most of the points lie behind a camera.
    error: float
    fits: bool | None  #: Whether the pose fits the images; None if that could not be checked.
    advice: str = ""  #: The reason and a remedy; empty if the pose fits.

    @property
    def verdict(self) -> str:
        """The result in words."""
        return _VERDICTS[self.fits]


@dataclass(frozen=True)
class RigCheck:
    """Result of checking the poses on the first frame."""

    matches: int  #: Number of matches, over all pairs of views.
    pairs: int  #: Number of pairs of views with matches.
    error: float  #: Median reprojection error, px; NaN without matches.
    cameras: tuple[CameraCheck, ...]  #: Result of each camera.
    #: Whether all poses fit the images; None if no pose is known to be wrong but some could not be
    #: checked.
    fits: bool | None
    advice: str  #: One sentence with the result, and the remedy if it is the same for all cameras.


def check_rig(capture: Capture, shared: SharedFeatures) -> RigCheck:
    """Return the result of checking the capture's cameras against the matches between its views."""
    return check_cameras(capture.at_recorded_size().cameras, capture.layout, shared)


def check_cameras(cameras: Sequence[Camera], layout: str, shared: SharedFeatures) -> RigCheck:
    """Return the result of checking cameras against the matches between their views.

    Args:
        cameras: one per view, at the size of its features.
        layout: of their file, the mistakes of which are looked for.
        shared: features of the views, and their matches.
    """
    pairs = _Pairs.of(shared, cameras)
    group = pairs.agreeing()
    checks = [_check(view, pairs, group) for view in range(len(cameras))]
    errors = pairs.errors
    # Of so few matches, a wrong correction explains enough by chance.
    has_many = 2 * len(errors) >= _MIN_MATCHES * len(checks)
    correction = _correct_rig(layout, pairs.sampled()) if has_many else None
    if correction:
        corrected = correction[0]
        # The views with another corrected camera are wrong.
        culprits = {v for v in pairs.views if corrected[v] is not pairs.cameras[v]}
        checks = [_check(view, pairs, pairs.views - culprits) for view in range(len(cameras))]
        for view in culprits:
            if checks[view].matches:
                checks[view] = replace(checks[view], fits=False, advice="")
    wrong = ", ".join(check.name for check in checks if check.fits is False)
    not_checked = ", ".join(check.name for check in checks if check.fits is None)
    fits = True
    advice = "the poses fit the images."
    if wrong:
        fits = False
        advice = f"the poses of {wrong} do not fit the images."
    elif not_checked:
        fits = None
        advice = f"the poses of {not_checked} could not be checked."
    if correction:
        advice = f"the poses do not fit the images: {correction[1]}."
    return RigCheck(len(errors), len(shared.matches), median(errors), tuple(checks), fits, advice)


def pose_problems(views: Sequence[View]) -> list[str]:
    """Return a sentence if poses are known not to fit the images of views, which may be in another
    order; otherwise none.
    """
    cameras = []
    features = []
    for index, view in enumerate(views):
        camera = view.camera.with_width(_WIDTH)
        width = min(max(view.camera.width, _LEAST_WIDTH), _WIDTH)
        size = (width, round(width * camera.height / _WIDTH))
        detected = detect(cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), view.mask)
        # In px of one size, as the limits of the errors are.
        features.append(replace(detected, points=detected.points * camera.size / size))
        cameras.append(replace(camera, name=camera.name or f"view {index}"))
    check = check_cameras(cameras, "", match_views(features, cameras))
    order = "a list of images has the cameras' order, a dict their names"
    return [f"{check.advice.rstrip('.')}; {order}."] if check.fits is False else []


@dataclass(frozen=True)
class _Pair:
    """Two views with matches."""

    match: Match  # the matches
    errors: np.ndarray  # their reprojection errors [M], px


@dataclass(frozen=True)
class _Pairs:
    """Reprojection errors of all pairs of views with matches."""

    shared: SharedFeatures  # the matches
    cameras: tuple[Camera, ...]  # the poses
    pairs: tuple[_Pair, ...]

    @classmethod
    def of(cls, shared: SharedFeatures, cameras: Sequence[Camera]) -> _Pairs:
        pairs = (_Pair(m, shared.reprojection_errors(m, cameras)) for m in shared.matches)
        return cls(shared, tuple(cameras), tuple(pairs))

    @property
    def views(self) -> set[int]:
        """The indices of all views."""
        return set(range(len(self.cameras)))

    @property
    def errors(self) -> np.ndarray:
        """The errors of all matches, px."""
        return np.concatenate([np.zeros(0), *(pair.errors for pair in self.pairs)])

    def of_view(self, view: int, partners: set[int]) -> np.ndarray:
        """Return the errors of a view's matches with `partners`, px."""
        views = partners | {view}
        parts = [
            p.errors for p in self.pairs if view in p.match.views and views >= {*p.match.views}
        ]
        return np.concatenate([np.zeros(0), *parts])

    def sampled(self, max_pairs: int | None = None) -> _Pairs:
        """Return the errors of a part of each pair's matches, for the `max_pairs` pairs with the
        most matches.
        """
        largest = sorted(self.shared.matches, key=lambda match: -len(match.features))[:max_pairs]
        few = (replace(m, features=m.features[:: -(-len(m.features) // _SAMPLE)]) for m in largest)
        return self.of(replace(self.shared, matches=tuple(few)), self.cameras)

    def worst(self) -> float:
        """Return the largest median error of a view, px; there must be matches."""
        return float(np.nanmax([median(self.of_view(view, self.views)) for view in self.views]))

    def agreeing(self) -> set[int]:
        """Return the views with mostly small errors in the matches between them.

        The view with the largest share of large errors is removed until no share exceeds a half,
        because a wrong pose spoils the matches of the other views too.
        """
        group = {view for match in self.shared.matches for view in match.views}
        while group:
            errors = {view: self.of_view(view, group) for view in sorted(group)}
            shares = {v: np.mean(e > MAX_ERROR) if len(e) else 1.0 for v, e in errors.items()}
            worst = max(shares, key=lambda view: shares[view])
            if shares[worst] <= 0.5:
                break
            group = group - {worst}
        return group


def median(errors: Sequence[float] | np.ndarray) -> float:
    """Return the median of some errors; NaN of none."""
    return float(np.median(errors)) if len(errors) else float("nan")


def _check(view: int, pairs: _Pairs, group: set[int]) -> CameraCheck:
    """Return the result of a view."""
    all_errors = errors = pairs.of_view(view, pairs.views)
    advice = ""
    if len(in_group := pairs.of_view(view, group)):
        errors = in_group
    elif group:
        advice = "matches only with cameras that do not fit: correct those first"
    if not len(errors):
        advice = f"no matches with any other camera: {_NO_OVERLAP}"
    elif not advice and len(errors) < _MIN_MATCHES:
        advice = f"only {len(errors)} matches, {_MIN_MATCHES} are needed: {_NO_OVERLAP}"
    if not len(pairs.shared.features[view].points):
        advice = _NO_FEATURES
    error = median(errors)
    fits = None if advice else error <= MAX_ERROR
    if fits is False:
        advice = _WRONG_POSE
    return CameraCheck(pairs.cameras[view].name, len(all_errors), error, fits, advice)


def _correct_rig(layout: str, pairs: _Pairs) -> tuple[Sequence[Camera], str] | None:
    """Return the cameras corrected for a mistake in several poses, and its description; None if
    none explains all.
    """
    error = pairs.worst()
    # The pairs with the most matches determine a factor on all focal lengths.
    largest = pairs.sampled(_FACTOR_PAIRS).shared
    candidates = focal_candidates(
        pairs.cameras, lambda cameras: median(_Pairs.of(largest, cameras).errors)
    )
    if error > _GOOD_ERROR:
        candidates = [*rig_candidates(pairs.cameras, layout), *candidates]
    errors = [_Pairs.of(pairs.shared, cameras).worst() for cameras, _ in candidates]
    if min(errors, default=np.inf) <= min(error / _GAIN, MAX_ERROR):
        return candidates[int(np.argmin(errors))]

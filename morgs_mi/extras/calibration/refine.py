"""Refinement of calibrated cameras on the first frame: poses, focal lengths, principal points and
radial distortion.

Beyond the paper. Features of the images are matched, and bundle adjustment gives the changes of the
cameras (see `bundle`), unless too few points are seen by a camera. Two fits from the same start are
then compared by the PSNR of withheld pixels, blocks of every training view that no fit uses: with
the calibrated cameras, and with the changed ones.

Cameras stay in the calibration's frame of reference and keep their mean focal length (see
`bundle`). A camera that is not refined, such as the one of the held-out view, therefore fits as
before. Points move with the cameras to keep their projections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.lens import Lens, undistorted, undistortion
from morgs_mi.core.camera import Camera
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.rig import scene_extent, seen_points
from morgs_mi.core.view import View
from morgs_mi.extras.calibration.bundle import (
    CHANGES,
    bundle_adjust,
    changed_camera,
    distorted,
    likely_deviations,
    prior_deviations,
)
from morgs_mi.fit.balance import short_fit_config
from morgs_mi.fit.far_views import PointCloud
from morgs_mi.fit.features import detect, intersect, match_views
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.fit.view import LEAST_GAIN, mean_psnr, withheld_blocks
from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.checks import require
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.progress import StepReport
from morgs_mi.render.render_config import RenderConfig

# A camera with features in fewer tracks is not determined by them.
_MIN_TRACKS = 40
# Least valid share of a resampled pixel.
_VALID = 0.999


@dataclass(frozen=True)
class Refinement:
    """Result of refining cameras."""

    taken: bool  #: Whether the refined cameras are used.
    #: PSNR of withheld pixels in a fit with the calibrated cameras, dB; NaN without a comparison.
    calibrated_psnr: float
    refined_psnr: float  #: PSNR of the same pixels in a fit with the refined cameras, dB.
    tracks: int  #: Number of points in the bundle adjustment; 0 if there were too few.
    rotation: float  #: Largest change of a rotation, degrees.
    position: float  #: Largest change of a position, world units.
    focal: float  #: Largest relative change of a focal length.
    #: Largest shift of a pixel by the remaining distortion, in image widths.
    distortion: float = 0.0

    @property
    def sentence(self) -> str:
        """The change of the cameras and its reason, in a sentence."""
        scores = (
            f": withheld pixels have {self.refined_psnr:.2f} dB instead of "
            f"{self.calibrated_psnr:.2f} dB"
        )
        reason = "" if np.isnan(self.calibrated_psnr) else scores
        if not self.tracks:
            return (
                "The cameras stay as calibrated: a camera shares too few features with others to "
                "be refined."
            )
        if not self.taken:
            return f"The cameras stay as calibrated, refined ones are no clear gain{reason}."
        sizes = (
            f"by up to {self.rotation:.2g} degrees, {self.position:.2g} units, "
            f"{100 * self.focal:.2g} % of the focal length and {100 * self.distortion:.2g} % of "
            "the image's width by the lens"
        )
        return f"The cameras were refined, {sizes}{reason}."

    def as_dict(self) -> JsonObject:
        """Return the result with its sentence, for the report of the first frame."""
        return {**asdict(self), "sentence": self.sentence}


def refine_cameras(
    capture: Capture,
    config: FitConfig,
    render: RenderConfig | None = None,
    seed: int = 0,
    progress: StepReport | None = None,
) -> tuple[Capture, Refinement]:
    """Return the capture with refined training cameras and moved points, if these are better, and
    the result.

    Args:
        capture: its first frame and its points are used, without the held-out view.
        config: settings of the fit; `refine_cameras` "on" selects the refined cameras without a
            comparison.
        render: cut-offs.
        seed: seed of all random choices.
        progress: called with (fits done, fits in all).

    Raises:
        ValueError: fewer than two training views have an image of the first frame.
    """
    render = config_or_default("refine_cameras()", render, RenderConfig(), "render")
    problem = RefinementProblem.of(capture, config, render, seed)
    changes, tracks = problem.matched()
    scores = [float("nan")] * 2
    if tracks and config.refine_cameras == "auto":
        scores = []
        for estimate in (np.zeros_like(changes), changes):
            if progress is not None:
                progress(len(scores), 2)
            scores.append(problem.score(estimate))
    calibrated, refined = scores
    is_better = tracks > 0 and not refined < calibrated + LEAST_GAIN
    sizes = _sizes(problem.changed_by(changes))
    refinement = Refinement(is_better, calibrated, refined, tracks, *sizes)
    return problem.changed_capture(changes) if is_better else capture, refinement


@dataclass(frozen=True, eq=False)
class RefinedView:
    """A training view with the change of its camera."""

    index: int  # of the view in the capture
    calibrated: Camera  # calibrated camera at the size of the capture
    visible: View  # reduced view without the withheld blocks
    withheld: View  # these blocks
    change: np.ndarray = field(default_factory=lambda: np.zeros(CHANGES))  # [11], see `bundle`

    @property
    def camera(self) -> Camera:
        """The changed camera at the size of the capture."""
        return changed_camera(self.calibrated, self.change)

    @property
    def lens(self) -> Lens:
        """The distortion that is left in the images."""
        return Lens("RADIAL", tuple(self.change[9:]))

    def corrected(self, view: View) -> View:
        """Return a reduced view with its changed camera, and without the distortion in its image
        and mask.
        """
        view = replace(view, camera=changed_camera(view.camera, self.change))
        correction = undistortion(view.camera, self.lens)
        if correction is None:
            return view
        valid = correction.mask
        if view.mask is not None:
            valid = valid & (correction(view.mask.astype(np.float32)) > _VALID)
        return replace(view, image=correction(view.image), mask=valid)


@dataclass(frozen=True, eq=False)
class RefinementProblem:
    """Cameras to refine, and the images that evaluate them."""

    capture: Capture  # capture with the calibrated cameras
    views: tuple[RefinedView, ...]  # the V training views with an image, without changes
    extent: float  # scene extent, world units
    config: FitConfig  # settings of the fit
    render: RenderConfig  # cut-offs
    seed: int  # seed of all random choices

    @classmethod
    def of(
        cls, capture: Capture, config: FitConfig, render: RenderConfig, seed: int
    ) -> RefinementProblem:
        """Return the problem of the first frame of a capture; raises as `refine_cameras`."""
        images = next(capture.displayed().partial_frames(0, 1)).views
        train = {v: images[v] for v in capture.train_views if images[v].has_image}
        require(
            len(train) > 1,
            "refine_cameras()",
            "expected images of at least two training views",
            len(train),
            "record more, or set `refine_cameras` to off",
        )
        rng = rng_of(seed, Stream.WITHHELD_BLOCKS)
        visible, withheld = withheld_blocks(list(train.values()), config.short_fits.width, rng)
        views = [
            RefinedView(v, capture.cameras[v], visible[k], withheld[k]) for k, v in enumerate(train)
        ]
        extent = scene_extent([view.camera for view in train.values()])
        return cls(capture, tuple(views), extent, config, render, seed)

    def changed_by(self, changes: np.ndarray) -> list[RefinedView]:
        """Return the views with changes [V, 11] of their cameras."""
        return [replace(v, change=change) for v, change in zip(self.views, changes, strict=True)]

    def matched(self) -> tuple[np.ndarray, int]:
        """Return the changes [V, 11] of the cameras by bundle adjustment, and the number of its
        points; without enough points, there are none, and no changes.
        """
        recording = self.capture.displayed().at_recorded_size()
        cameras = [recording.cameras[view.index] for view in self.views]
        images = next(recording.partial_frames(0, 1)).images
        features = [detect(images[v.index], recording.masks[v.index]) for v in self.views]
        tracks = match_views(features, cameras).tracks()
        if np.bincount(tracks.views, minlength=len(cameras)).min() < _MIN_TRACKS:
            return np.zeros((len(cameras), CHANGES)), 0
        deviations = prior_deviations(self.extent, self.config.camera_priors)
        deviations = likely_deviations(cameras, tracks, deviations)
        return bundle_adjust(cameras, tracks, deviations)[0], tracks.count

    def score(self, changes: np.ndarray) -> float:
        """Return the PSNR of the withheld pixels, dB, after a fit with changed cameras."""
        views = self.changed_by(changes)
        problem = FirstFrameProblem.of(
            [view.corrected(view.visible) for view in views],
            PointCloud(_moved(self.capture.points, views), self.capture.point_colors),
            self._short,
            self.render,
            rng_of(self.seed, Stream.REFINED_POINTS),
        )
        fit = fit_first_frame(problem, self._short, rng_of(self.seed, Stream.REFINEMENT))
        withheld = [view.corrected(view.withheld) for view in views]
        return mean_psnr(fit.gaussians, withheld, self.render)

    def changed_capture(self, changes: np.ndarray) -> Capture:
        """Return the capture with changed cameras and moved points."""
        cameras = list(self.capture.cameras)
        distortions = np.zeros((len(cameras), 2))
        views = self.changed_by(changes)
        for view in views:
            cameras[view.index] = view.camera
            distortions[view.index] = view.change[9:]
        rig = self.capture.with_cameras(cameras, distortions.tolist())
        return replace(rig, points=_moved(self.capture.points, views))

    @property
    def _short(self) -> FitConfig:
        """Settings of a short fit."""
        steps = self.config.short_fits.steps
        return replace(short_fit_config(self.config), first_frame_steps=steps)


def _sizes(views: Sequence[RefinedView]) -> list[float]:
    """Return the largest change of a rotation, degrees, a position, a focal length, and a pixel by
    the lens.
    """
    shifts = []
    for view in views:
        camera = view.calibrated
        corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * camera.size
        shifts.append((distorted(camera, corners, view.change[9:]) - corners) / camera.width)
    changes = np.array([view.change for view in views])
    vectors = (np.rad2deg(changes[:, :3]), changes[:, 3:6], changes[:, 6:7], np.concatenate(shifts))
    return [float(np.linalg.norm(each, axis=1).max()) for each in vectors]


def _moved(points: np.ndarray, views: Sequence[RefinedView]) -> np.ndarray:
    """Return points [P, 3] moved to keep their projections in the views that show them, with
    changed cameras.
    """
    rig = [view.camera for view in views]
    masks = []
    pixels = []
    for view in views:
        mask, seen, _ = seen_points(view.calibrated, points)
        masks.append(mask)
        pixels.append(undistorted(view.camera, view.lens, seen))
    shown_by, ids = np.nonzero(masks)
    intersections = intersect(ids, shown_by, np.concatenate(pixels), rig, len(points))
    is_determined = (np.sum(masks, axis=0) >= 2) & np.isfinite(intersections).all(axis=1)
    return np.where(is_determined[:, None], intersections, points).astype(np.float32)

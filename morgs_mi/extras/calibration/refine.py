"""Refinement of calibrated cameras on the first frame: poses, focal lengths, principal points and
radial distortion.

Beyond the paper. Features of the images are matched, and bundle adjustment gives the changes of the
cameras (see `bundle`), unless too few points are seen by a camera. Two fits from the same start are
then compared by the PSNR of withheld pixels, blocks of every training view that no fit uses: with
the calibrated cameras, and with the changed ones.

Cameras stay in the calibration's frame of reference and keep their mean focal length (see
`bundle`). A camera that is not refined therefore fits as before. Points move with the cameras to
keep their projections. The held-out view keeps its calibrated camera; `register_camera` fits a
camera to its image while the Gaussians are frozen. With their blend weights w fixed, the error e =
target - image is linear in the shift u of a splat (Lucas and Kanade 1981; as in `method.motion`):
with the gradient g, it becomes e + g . u. A Gaussian is therefore an observation of
`NormalEquations` with

    G = sum_x w g g' / v,    b = sum_x w e g / v,

where the variance v is the mean square error times the number of pixels with similar errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.capture.lens import Lens, undistorted, undistortion
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.rig import scene_extent, seen_points
from morgs_mi.core.view import View
from morgs_mi.extras.calibration.bundle import (
    CHANGES,
    NormalEquations,
    bundle_adjust,
    camera_jacobian,
    changed_camera,
    distorted,
    likely_deviations,
    prior_deviations,
)
from morgs_mi.extras.calibration.offset_equations import (
    blurred,
    gradient_products,
    image_gradient,
)
from morgs_mi.fit.balance import short_fit_config
from morgs_mi.fit.features import detect, intersect, join_matches, match_views
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.fit.view import LEAST_GAIN, mean_psnr, withheld_blocks
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.ssim import Target
from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.checks import require
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.progress import StepReport
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.render_config import RenderConfig

# A camera with features in fewer tracks is not determined by them.
_MIN_TRACKS = 40
# Number of pixels with similar errors, because the fit lacks a detail there. They count as one
# pixel: otherwise priors would have no influence, and a camera would follow the errors of the fit.
_ALIKE = 10.0
# px, standard deviations of the blur of images and gradients, one after the other: a blurred image
# registers errors of several pixels.
_BLURS = (2.0, 1.0, 0.0)
# Error at which a pixel has half its weight, relative to white: larger errors are details that the
# fit lacks.
_HALF_WEIGHT = 0.1
# Least mean square error: a rendering compared with itself has an error of 0.
_LEAST_ERROR = 1e-10
# Deviation of a fixed distortion; least valid share of a resampled pixel.
_NO_DISTORTION = 1e-4
_VALID = 0.999
# Steps of the registration of a camera, which end when they change its pixels by less than this,
# px.
_REGISTRATION_STEPS = 30
_LEAST_SHIFT = 1e-3


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

    def validation(
        self, capture: Capture, gaussians: Gaussians, frame: PartialFrame, config: StreamConfig
    ) -> JsonObject:
        """Return the result with its sentence, and the PSNR of the held-out views with a sentence,
        if there are any.

        The PSNR is the mean over these views, in dB: once with the calibrated cameras, once with
        registered ones.

        Args:
            capture: with the refined cameras.
            gaussians: of the first frame.
            frame: its images.
            config: settings of the fit.
        """
        result = {**asdict(self), "sentence": self.sentence}
        test = capture.views.at(frame.images).test
        views = [view for view in test if view.has_image]
        if not views:
            return result
        extent = scene_extent(capture.views.train.cameras)
        registered = [
            replace(
                view, camera=register_camera(gaussians, view, extent, config.fit, config.render)
            )
            for view in views
        ]
        rigs = {"calibrated_psnr": views, "registered_psnr": registered}
        held_out: JsonObject = {
            name: mean_psnr(gaussians, rig, config.render) for name, rig in rigs.items()
        }
        held_out["sentence"] = (
            f"Held-out views have {held_out['calibrated_psnr']:.1f} dB as calibrated, "
            f"{held_out['registered_psnr']:.1f} dB registered."
        )
        return result | {"held_out": held_out}


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
    refinement = Refinement(
        is_better, calibrated, refined, tracks, *_sizes(problem.cameras, changes)
    )
    return problem.changed_capture(changes) if is_better else capture, refinement


@dataclass(frozen=True, eq=False)
class RefinementProblem:
    """Cameras to refine, and the images that evaluate them."""

    capture: Capture  # capture with the calibrated cameras
    indices: tuple[int, ...]  # indices of the V training views with an image
    views: tuple[View, ...]  # these views, reduced, without the withheld blocks
    unseen: tuple[View, ...]  # their withheld blocks
    extent: float  # scene extent, world units
    config: FitConfig  # settings of the fit
    render: RenderConfig  # cut-offs
    seed: int  # seed of all random choices

    @classmethod
    def of(
        cls, capture: Capture, config: FitConfig, render: RenderConfig, seed: int
    ) -> RefinementProblem:
        """Return the problem of the first frame of a capture; raises as `refine_cameras`."""
        views = next(capture.displayed().partial_frames(0, 1)).views
        train = {v: views[v] for v in capture.train_views if views[v].has_image}
        require(
            len(train) > 1,
            "refine_cameras()",
            "expected images of at least two training views",
            len(train),
            "record more, or set `refine_cameras` to off",
        )
        rng = rng_of(seed, Stream.WITHHELD_BLOCKS)
        visible, withheld = withheld_blocks(list(train.values()), config.short_fits.width, rng)
        extent = scene_extent([view.camera for view in train.values()])
        return cls(
            capture, tuple(train), tuple(visible), tuple(withheld), extent, config, render, seed
        )

    @property
    def cameras(self) -> list[Camera]:
        """The calibrated cameras at the size of the capture."""
        return [self.capture.cameras[v] for v in self.indices]

    def matched(self) -> tuple[np.ndarray, int]:
        """Return the changes [V, 11] of the cameras by bundle adjustment, and the number of its
        points; without enough points, there are none, and no changes.
        """
        recording = self.capture.displayed().at_recorded_size()
        cameras = [recording.cameras[v] for v in self.indices]
        images = next(recording.partial_frames(0, 1)).images
        features = [detect(images[v], recording.masks[v]) for v in self.indices]
        tracks = join_matches(match_views(features, cameras), features)
        if np.bincount(tracks.views, minlength=len(cameras)).min() < _MIN_TRACKS:
            return np.zeros((len(cameras), CHANGES)), 0
        deviations = prior_deviations(self.extent, self.config.camera_priors)
        deviations = likely_deviations(cameras, tracks, deviations)
        return bundle_adjust(cameras, tracks, deviations)[0], tracks.count

    def score(self, changes: np.ndarray) -> float:
        """Return the PSNR of the withheld pixels, dB, after a fit with changed cameras."""
        problem = FirstFrameProblem.of(
            _changed(self.views, changes),
            (_moved(self.capture.points, self.cameras, changes), self.capture.point_colors),
            self._short,
            self.render,
            rng_of(self.seed, Stream.REFINED_POINTS),
        )
        fit = fit_first_frame(problem, self._short, rng_of(self.seed, Stream.REFINEMENT))
        return mean_psnr(fit.gaussians, _changed(self.unseen, changes), self.render)

    def changed_capture(self, changes: np.ndarray) -> Capture:
        """Return the capture with changed cameras and moved points."""
        cameras = list(self.capture.cameras)
        distortions = np.zeros((len(cameras), 2))
        for v, change in zip(self.indices, changes, strict=True):
            cameras[v] = changed_camera(cameras[v], change)
            distortions[v] = change[9:]
        rig = self.capture.with_cameras(cameras, distortions.tolist())
        return replace(rig, points=_moved(self.capture.points, self.cameras, changes))

    @property
    def _short(self) -> FitConfig:
        """Settings of a short fit."""
        steps = self.config.short_fits.steps
        return replace(short_fit_config(self.config), first_frame_steps=steps)


def register_camera(
    gaussians: Gaussians,
    view: View,
    extent: float,
    config: FitConfig,
    render: RenderConfig,
) -> Camera:
    """Return the camera, near the given one, with which frozen Gaussians fit an image best.

    Args:
        gaussians: frozen.
        view: the calibrated camera and its image.
        extent: scene extent, world units.
        config: settings with the priors of the changes.
        render: cut-offs.
    """
    priors = replace(config.camera_priors, distortion=_NO_DISTORTION)  # the image is not changed
    deviations = prior_deviations(extent, priors)
    target = Target(view.image, view.mask)
    means = np.asarray(gaussians.means, np.float64)
    best = np.zeros((1, CHANGES))
    for blur in _BLURS:
        changes = best
        error = np.inf
        for _ in range(_REGISTRATION_STEPS):
            camera = changed_camera(view.camera, changes[0])
            G, b, new_error = _shifts(gaussians, camera, target, blur, render)
            if not new_error < error:
                break
            best = changes
            error = new_error
            of_camera, _ = camera_jacobian(camera, 1 + changes[0, 6], means)
            equations = NormalEquations(1, 0)
            equations.add_camera(0, of_camera, G / error / _ALIKE, b / error / _ALIKE)
            step, _ = equations.step(changes, deviations, 0.0, np.zeros((0, CHANGES)))
            changes = changes + step
            if np.abs(of_camera @ step[0]).mean() < _LEAST_SHIFT:
                break
    return changed_camera(view.camera, best[0])


def _changed(views: Sequence[View], changes: np.ndarray) -> list[View]:
    """Return views with changed cameras, and images and masks without the cameras' distortion."""
    changed_views = []
    for view, change in zip(views, changes, strict=True):
        view = replace(view, camera=changed_camera(view.camera, change))
        correction = undistortion(view.camera, Lens("RADIAL", tuple(change[9:])))
        if correction is not None:
            valid = correction.mask
            if view.mask is not None:
                valid = valid & (correction(view.mask.astype(np.float32)) > _VALID)
            view = replace(view, image=correction(view.image), mask=valid)
        changed_views.append(view)
    return changed_views


def _sizes(cameras: Sequence[Camera], changes: np.ndarray) -> list[float]:
    """Return the largest change of a rotation, degrees, a position, a focal length, and a pixel by
    the lens.
    """
    shifts = []
    for camera, change in zip(cameras, changes, strict=True):
        corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * camera.size
        shifts.append((distorted(camera, corners, change[9:]) - corners) / camera.width)
    vectors = (np.rad2deg(changes[:, :3]), changes[:, 3:6], changes[:, 6:7], np.concatenate(shifts))
    return [float(np.linalg.norm(each, axis=1).max()) for each in vectors]


def _moved(points: np.ndarray, cameras: Sequence[Camera], changes: np.ndarray) -> np.ndarray:
    """Return points [P, 3] moved to keep their projections in the views that show them, with
    changed cameras.
    """
    rig = [changed_camera(*pair) for pair in zip(cameras, changes, strict=True)]
    masks, pixels, _ = zip(*(seen_points(camera, points) for camera in cameras), strict=True)
    lenses = (Lens("RADIAL", tuple(terms)) for terms in changes[:, 9:])
    pixels = map(undistorted, rig, lenses, pixels)
    views, ids = np.nonzero(masks)
    intersections = intersect(ids, views, np.concatenate([*pixels]), rig, len(points))
    is_determined = (np.sum(masks, axis=0) >= 2) & np.isfinite(intersections).all(axis=1)
    return np.where(is_determined[:, None], intersections, points).astype(np.float32)


def _shifts(
    gaussians: Gaussians, camera: Camera, target: Target, blur: float, render: RenderConfig
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return G v [N, 2, 2] and b v [N, 2] of the module docstring in a view, and the mean square
    error.
    """
    view = ActiveView(camera, render)
    image = render_view(gaussians, view).color
    error = target.difference(image)
    square = max(float(np.mean(error**2)), _LEAST_ERROR)
    # The mean of the rendering and the target, or the rendering where the target is masked.
    gradient = image_gradient(blurred((np.asarray(image) + 0.5 * error).astype(np.float32), blur))
    error = blurred(error, blur)
    weight = 1 / (1 + np.sum(error**2, axis=-1) / _HALF_WEIGHT**2)
    return *gradient_products(gaussians, view, error, gradient, weight), square

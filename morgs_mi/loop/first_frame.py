"""Fit of the first frame: from images and points to a keyframe, and later its confidence."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import decode, keyframe_packet
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.view import View, Views
from morgs_mi.fit.balance import balance_cameras, short_fit_config
from morgs_mi.fit.budget import plan_first_frame
from morgs_mi.fit.far_views import PointCloud
from morgs_mi.fit.first_frame import (
    MotionMask,
    adapted_to_images,
    fit_confidence,
    fit_first_frame,
)
from morgs_mi.fit.forecast import forecast
from morgs_mi.fit.image_points import image_points
from morgs_mi.fit.initialise import (
    MANY_POINTS,
    MIN_POINTS,
    NO_POINTS,
    FirstFrameProblem,
    has_points,
    unseen_points,
)
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.input_images import FrameImages
from morgs_mi.loop.observation import (
    FrameObservation,
    ImageHistory,
    Setup,
    observe_frame,
    over_border,
    prepare,
)
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.exposure import Exposure
from morgs_mi.method.objective import KeyView
from morgs_mi.platform.checks import check_type, numbers
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.extras import extra, places
from morgs_mi.platform.interrupts import interrupts_raised
from morgs_mi.platform.progress import Progress, Report, duration
from morgs_mi.render.render_config import RenderConfig

_LOG = logging.getLogger(__name__)
# Rounds of a preview, and the steps of the first one: 24 dB on basketball after two.
_PREVIEWS = 3
_PREVIEW_STEPS = 500


@dataclass(frozen=True, eq=False)
class FittedImages:
    """Result of `fit_gaussians`."""

    gaussians: Gaussians  #: The Gaussians.
    render: RenderConfig  #: Settings they are drawn with, and the background, given or found.
    report: FrameReport  #: Of the fit.

    @property
    def background(self) -> tuple[float, float, float] | None:
        """Colour behind all Gaussians, encoded; None: black, or the images of the cameras."""
        return self.render.background


@interrupts_raised()
def fit_gaussians(
    sensors: Sequence[Any],
    images: FrameImages,
    points: np.ndarray | None = None,
    point_colors: np.ndarray | None = None,
    config: StreamConfig | None = None,
    background: ArrayLike | None = None,
    progress: Report | None = None,
) -> FittedImages:
    """Return Gaussians fitted to images of one timestamp, as `StreamLoop` fits its first frame:
    with its starts, balance of the cameras, density control and dropout.

    Args:
        sensors: V views: `Camera`s, Mitsuba's `perspective` sensors, or a `View` of a camera with
            the mask of its valid pixels.
        images: an image [H, W, 3] per view: uint8 in sRGB, linear light as a float array or a
            `mi.TensorXf`, or a `mi.Bitmap`, whose flag `srgb_gamma` counts. A dict has them by the
            names of the views.
        points: [P, 3] of the scene, world units. None, fewer than 20, or points of which the
            cameras see less than 5 %: those that matched images show, or, if these are fewer than
            1000, random ones where views agree (see `seed_points`).
        point_colors: [P, 3], encoded: 1 is white; None: grey.
        config: settings of the first frame and the renderer; None: the defaults.
        background: colour [3] behind all Gaussians, encoded: 1 is white; or an image [V, H, W, 3],
            as of `Camera`. None: the background of the cameras and the config; if these have none
            and there are no points, the colour that the borders of the images have in common.
        progress: called with (stage, done, total).

    Example:
        >>> sensors = scene.sensors()
        >>> images = [mi.render(scene, sensor=sensor) for sensor in sensors]
        >>> fitted = morgs_mi.fit_gaussians(sensors, images)
        >>> camera = morgs_mi.Camera.from_sensor(sensors[0])
        >>> image = morgs_mi.rasterize(fitted.gaussians, camera, config=fitted.render)

    Raises:
        ValueError: as for `StreamLoop` and `StreamLoop.push`.
    """
    begin = time.perf_counter()
    points = np.zeros((0, 3)) if points is None else points
    point_colors = np.full(np.shape(points), 0.5) if point_colors is None else point_colors
    check_type("fit_gaussians()", "sensors", sensors, Sequence, "pass a list")
    views = [s if isinstance(s, View) else View(Camera.of(s)) for s in sensors]
    config = config_or_default("fit_gaussians()", config, StreamConfig())
    if background is not None:
        behind = np.asarray(background)
        if behind.ndim < 2 or behind.size == 3:
            render = replace(config.render, background=tuple(behind.ravel().tolist()))
            config = replace(config, render=render)
        else:
            numbers("fit_gaussians()", "background", behind, len(views), *behind.shape[1:])
            views = [
                replace(view, camera=replace(view.camera, background=behind[v]))
                for v, view in enumerate(views)
            ]
    setup = over_border(prepare(views, points, point_colors, config), images)
    observed = observe_frame(setup, 0, ImageHistory(), images)
    warn_of_order(images, observed)
    packet, report = fitted_first_frame(setup, observed, Progress(progress, "Frame 0"), None)
    seconds = time.perf_counter() - begin
    report = replace(report, seconds=seconds, status=report.status or "ok")
    return FittedImages(decode(None, packet).gaussians, setup.config.render, report)


def warn_of_order(images: FrameImages, observed: FrameObservation) -> None:
    """Warn if images seem to be in another order than the cameras; in a dict they have names.

    Args:
        images: of the first frame, as they were given.
        observed: the views that have one.
    """
    if not isinstance(images, Mapping | Views) and "problems" in places("cameras"):
        for problem in extra("cameras", "problems")([*observed.views.values()]):
            _LOG.warning("frame 0: %s", problem)


def fitted_first_frame(
    setup: Setup,
    observed: FrameObservation,
    progress: Progress,
    on_provisional: Callable[[Packet], None] | None,
) -> tuple[Packet, FrameReport]:
    """Return the keyframe of the first frame, and the report of its fit.

    Args:
        setup: data that all frames share.
        observed: the views with their images.
        progress: of the stages.
        on_provisional: called with provisional keyframes during the fit; None: there are none.
    """
    begin = time.perf_counter()
    config = setup.config
    problems = [unseen_points(setup.cameras, setup.points)]
    if not has_points(setup.cameras, setup.points):
        points, colors = _found_points(setup, observed, progress)
        setup = replace(setup, points=points, point_colors=colors)
    on_round = _on_round(setup, on_provisional)
    exposures, exposure_entry = _balanced(setup, observed, progress, on_round)
    views = [view.in_scene(exposures) for view in observed.views.values()]
    rng = rng_of(config.seed, Stream.FIRST_FRAME)
    plan, seconds = plan_first_frame(views, setup.points, config.fit)
    cloud = PointCloud(setup.points, setup.point_colors)
    problem = FirstFrameProblem.of(views, cloud, plan, config.render, rng)
    fit_config = adapted_to_images(plan, problem)

    count = len(setup.points)
    if count < MIN_POINTS:
        problems.append(
            f"too few points ({count}): {plan.first_count} more were initialised from the images"
        )
    validation: dict[str, Any] = {}
    if len(views) > 1:
        expected = forecast(problem.cameras, problem.points)
        quality = {"sentence": expected.sentence, "quality": expected.quality}
        validation = {**quality, **asdict(expected), **exposure_entry}
    limit = config.fit.first_frame_seconds
    forecast_text = ""
    if seconds is None:  # both numbers are given
        limit = None
    elif limit is not None:  # whose seconds are counted
        limit = max(limit - (time.perf_counter() - begin), 1.0)
    else:
        forecast_text = f", about {duration(max(seconds, 1))}"
    stage = progress.forecast("First frame", forecast_text)
    stage(0, 1)
    begin = time.perf_counter()
    fitted = fit_first_frame(problem, fit_config, rng, stage, on_round, limit)
    if fitted.steps < plan.planned_steps:  # to keep the limit
        seconds = time.perf_counter() - begin
        whole = duration(seconds * plan.planned_steps / fitted.steps)
        sentence = (
            f"{fitted.steps:,} of {plan.planned_steps:,} planned steps in {seconds:.0f} s: a "
            f"draft; about {whole} for all."
        )
        validation["draft"] = {"sentence": sentence, "planned_steps": plan.planned_steps}
    problems = list(filter(None, [*problems, fitted.problem]))
    for sentence in problems:
        _LOG.warning("frame 0: %s", sentence)
    packet = keyframe_packet(fitted.gaussians, 0, setup.cameras, config.codec)
    report = FrameReport(
        frame=0,
        seconds=0.0,
        num_bytes=packet.num_bytes,
        losses=fitted.losses,
        num_gaussians=len(fitted.gaussians),
        psnr=fitted.psnr,
        status="; ".join(problems),
        validation=validation,
        steps=fitted.steps,
        exposures=exposures,
    )
    return packet, report


def _found_points(setup: Setup, observed: FrameObservation, progress: Progress) -> PointCloud:
    """Return the points that are found in the images, none if these are too few to cover the
    views.
    """
    progress.of("Matching views")(0, 1)
    rng = rng_of(setup.config.seed, Stream.POINTS)
    points = PointCloud(*image_points([*observed.views.values()], rng))
    return points if points.count >= MANY_POINTS else NO_POINTS


def preview(
    setup: Setup, images: FrameImages, progress: Progress, on_provisional: Callable[[Packet], None]
) -> None:
    """Make provisional keyframes by short fits of the first frame, for a picture within seconds
    while better points are still to be found; arguments as for `step`, and the stage's progress.
    """
    fit = setup.config.fit
    short_fits = replace(fit.short_fits, rounds=_PREVIEWS, steps=_PREVIEW_STEPS)
    config = replace(setup.config, fit=replace(fit, exposure="on", short_fits=short_fits))
    setup = replace(setup, config=config)
    observed = observe_frame(setup, 0, ImageHistory(), images)
    _balanced(setup, observed, progress.part(0, 1), _on_round(setup, on_provisional))


def _on_round(
    setup: Setup, on_provisional: Callable[[Packet], None] | None
) -> Callable[[Gaussians], None] | None:
    """Return a function that makes a provisional keyframe of Gaussians; None: there are none."""
    if on_provisional is None:
        return None
    cameras = setup.cameras
    return lambda g: on_provisional(keyframe_packet(g, 0, cameras, setup.config.codec))


def _balanced(
    setup: Setup,
    observed: FrameObservation,
    progress: Progress,
    on_round: Callable[[Gaussians], None] | None,
) -> tuple[tuple[Exposure, ...], dict[str, Any]]:
    """Return the exposures of all views by the balance of the cameras, empty if they are not
    estimated, and the entry of the first frame's report.
    """
    config = setup.config
    if config.fit.exposure == "off":
        return (), {}
    exposures = [Exposure() for _ in setup.views]
    entry: dict[str, Any] = {}
    if len(observed.views) > 1:
        rng = rng_of(config.seed, Stream.BALANCED_POINTS)
        fit = short_fit_config(config.fit)
        cloud = PointCloud(setup.points, setup.point_colors)
        views = [view.in_scene() for view in observed.views.values()]
        problem = FirstFrameProblem.of(views, cloud, fit, config.render, rng)
        balance = balance_cameras(problem, config.fit, config.seed, progress, on_round)
        if balance.taken:
            for v, exposure in zip(observed.views, balance.exposures, strict=True):
                exposures[v] = exposure
        entry["exposure"] = {
            "sentence": balance.sentence,
            "taken": balance.taken,
            "recorded_psnr": balance.recorded_psnr,
            "balanced_psnr": balance.balanced_psnr,
        }
    return tuple(exposures), entry


def with_first_confidence(
    setup: Setup,
    gaussians: Gaussians,
    key_views: Mapping[int, KeyView],
    rng: np.random.Generator,
) -> Gaussians:
    """Return the Gaussians of the first frame with a confidence learned from the masks of that
    frame (eqs. 9 to 11).

    Args:
        setup: data that all frames share.
        gaussians: the Gaussians.
        key_views: in the second frame, with the optical flow between the two, by view index.
        rng: of the order of the views.
    """
    config = setup.config
    motion = config.motion
    if not (key_views and motion.learn_confidence and config.fit.confidence_steps):
        return gaussians
    masks = [
        MotionMask(
            setup.cameras[v],
            motion_mask(
                key_views[v].pair.previous,
                key_views[v].flow.forward_flow,
                key_views[v].flow.forward_reliable,
                motion.mask_method,
                motion.masks,
            ),
        )
        for v in sorted(key_views)
    ]
    return fit_confidence(gaussians, masks, config.fit, config.render, rng)[0]

"""The causal loop from the frames of fixed cameras to a stream of residuals.

The first frame is reconstructed and written as a keyframe; every later frame is a gated residual that is guided by the
optical flow of a few key views. The mathematics is in `method`, the optimisation in `fit`. Encoder and decoder
cannot drift apart, because the next frame always starts from the decoded packet.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import CodedFrame, decode, keyframe_packet, residual_packet
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.interrupts import interrupts_raised
from morgs_mi.core.progress import Progress, Report
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.threads import in_background
from morgs_mi.fit.budget import plan_first_frame
from morgs_mi.fit.dropping import adapted_to_images
from morgs_mi.fit.first_frame import fit_confidence, fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import MIN_POINTS
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.fit.unseen_views import unseen_views
from morgs_mi.loop.correction import Correction, estimate_correction
from morgs_mi.loop.image_status import image_status
from morgs_mi.loop.input_images import Given, as_array
from morgs_mi.loop.observation import (
    FrameObservation,
    Images,
    Recorded,
    Seen,
    Setup,
    observe_frame,
    prepare,
    see_frame,
    views_of,
)
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.active_set import ActiveSet, find_active_set, full_active_set
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.exposure import Exposure
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.motion import initial_motion
from morgs_mi.method.objective import Observations, channels_of, observe
from morgs_mi.method.ssim import Target

__all__ = ["FrameReport", "StreamLoop", "StreamState", "step"]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameReport:
    """Report of one frame.

    Attributes:
        frame: its index.
        seconds: wall time from the images to the packet, optical flow and optimisation included.
        num_bytes: size of the packet in the stream.
        losses: means over the last steps, by the names of the terms.
        num_gaussians: number of Gaussians of the frame.
        status: "ok", or a sentence about a problem and how it was handled.
        missing_views: names of the views without an image.
        active: fractions that took part, by name: gaussians, views, pixels, epochs.
        validation: of the first frame, a `sentence` on views between the cameras, with the fields of `UnseenViews`
            (see `fit.unseen_views`); empty with a single view.
        steps: number of optimisation steps.
        exposures: gain and bias of each view; empty if they are not estimated.
    """

    frame: int
    seconds: float
    num_bytes: int
    losses: dict[str, float]
    num_gaussians: int
    status: str = "ok"
    missing_views: tuple[str, ...] = ()
    active: dict[str, float] = field(default_factory=dict)
    validation: dict[str, Any] = field(default_factory=dict)
    steps: int = 0
    exposures: tuple[Exposure, ...] = ()


@dataclass(frozen=True, eq=False)
class StreamState:
    """State that one frame hands to the next.

    It follows from the stream and the recording. An interrupted fit can therefore be resumed exactly (see `recording`).

    Attributes:
        frame: index of the next frame.
        coded: state of a decoder after the last frame; None before the first.
        seen: images up to the last frame.
        correction: of the images to the colours of the scene.
    """

    frame: int = 0
    coded: CodedFrame | None = None
    seen: Seen = field(default_factory=Seen)
    correction: Correction = field(default_factory=Correction)

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.coded.gaussians if self.coded else None


@dataclass(frozen=True)
class _Fitted:
    """Result of the fit of a frame: its packet, entries of its `FrameReport`, and the correction of its images."""

    packet: Packet
    correction: Correction
    losses: dict[str, float]
    steps: int
    status: str
    active: dict[str, float] = field(default_factory=dict)
    validation: dict[str, Any] = field(default_factory=dict)


@interrupts_raised()
def step(
    setup: Setup,
    state: StreamState,
    images: Sequence[Given | None] | FrameObservation,
    progress: Report | None = None,
    on_provisional: Callable[[Packet], None] | None = None,
) -> tuple[StreamState, Packet, FrameReport]:
    """Fit one frame and return (state, packet, report). The function is pure: all state is returned.

    Args:
        setup: data that all frames share, as from `prepare`.
        state: as returned for the last frame; `StreamState()` before the first.
        images: per training view an image [H, W, 3], RGB, or None where the view has none: uint8 in sRGB, linear light
            as a float array or a `mi.TensorXf`, or a `mi.Bitmap`, whose flag `srgb_gamma` counts. They are copied.
            Alternatively, the result of `observe_frame` for them.
        progress: called with (stage, done, total): the stages of the first frame, or the steps of a later one.
        on_provisional: called with provisional keyframes while the first frame is fitted.

    Raises:
        ValueError: an image has another size or type than its camera, or the first frame has no image at all.
    """
    start = time.perf_counter()
    frame_progress = Progress(progress, f"Frame {state.frame}")
    observed = images if isinstance(images, FrameObservation) else observe_frame(setup, state.frame, state.seen, images)
    if state.coded is None:
        fitted = _fit_first_frame(setup, observed, frame_progress, on_provisional)
    else:
        fitted = _fit_later_frame(setup, state, observed, frame_progress)
    coded = decode(state.coded, fitted.packet)
    seen = observed.seen
    report = FrameReport(
        frame=state.frame,
        seconds=time.perf_counter() - start,
        num_bytes=fitted.packet.num_bytes,
        losses=fitted.losses,
        num_gaussians=len(coded),
        status=_status(setup, state, seen.images, fitted.status),
        missing_views=tuple(camera.name for v, camera in enumerate(setup.cameras) if v not in seen.images),
        active=fitted.active,
        validation=fitted.validation,
        steps=fitted.steps,
        exposures=fitted.correction.followed_by(seen.exposures),
    )
    return StreamState(state.frame + 1, coded, seen, fitted.correction), fitted.packet, report


def _status(setup: Setup, state: StreamState, images: Images, status: str) -> str:
    """Return the status of a frame with the problems of its images, which are logged in the first frame."""
    problems = image_status([camera.name for camera in setup.cameras], state.seen.images, images)
    for problem in problems if state.coded is None else ():
        _LOG.warning("frame 0: %s", problem)
    return "; ".join([*([] if status == "ok" else [status]), *problems]) or "ok"


def _fit_later_frame(setup: Setup, state: StreamState, observed: FrameObservation, progress: Progress) -> _Fitted:
    """Return the fit of a later frame; numbers refer to the paper's equations."""
    assert state.coded is not None
    config, motion, images, flows = setup.config, setup.config.motion, observed.seen.images, observed.flows
    rng = rng_of(config.seed, Stream.LATER_FRAMES, state.frame)  # of its own for each frame: it is no state
    previous = _first_confidence(setup, state, flows, rng)  # frame 0's confidence (11)
    observations = observe(observed.key_views, motion, config.fit.objective)
    active = _active_set(setup, previous, images, observed.changes, observations)
    corrected = state.correction.corrected({view: observed.encoded[view] for view in active.views})
    targets = {view: Target(image, setup.masks[view]) for view, image in corrected.items()}
    initial = initial_motion(previous, active, flows, targets, motion, rng)  # motion (5)
    problem = FrameProblem(previous, active, targets, observations, initial, setup.extent)
    fitted = fit_later_frame(problem, config.fit, motion, rng, progress)  # residual (6-8, 12), objective (13)
    packet = residual_packet(state.coded, fitted.gaussians, fitted.source, setup.cameras, config.codec)  # (3)
    return _Fitted(
        packet=packet,
        correction=state.correction,
        losses=fitted.losses,
        steps=fitted.epochs * len(active.views),
        status="ok" if images else "no view has an image",
        active={**active.fractions, "epochs": fitted.epochs / config.fit.epochs},
    )


def _fit_first_frame(
    setup: Setup,
    observed: FrameObservation,
    progress: Progress,
    on_provisional: Callable[[Packet], None] | None,
) -> _Fitted:
    """Return the fit of the first frame."""
    config = setup.config
    correction, correction_entry = estimate_correction(setup, observed.encoded, progress)
    views = views_of(setup, correction.corrected(observed.encoded))
    rng = rng_of(config.seed, Stream.FIRST_FRAME)
    plan = plan_first_frame(views, setup.points, config.fit)
    problem = FirstFrameProblem.of(views, setup.cloud, plan.config, config.render, rng)
    fit_config = adapted_to_images(plan.config, problem)

    def packed(gaussians: Gaussians) -> Packet:
        return keyframe_packet(gaussians, 0, setup.cameras, config.codec)

    on_round = None if on_provisional is None else lambda gaussians: on_provisional(packed(gaussians))
    fitted = fit_first_frame(problem, fit_config, rng, progress.of(plan.stage), on_round)
    forecast = unseen_views(problem, fitted.gaussians).entries if len(views) > 1 else {}
    return _Fitted(
        packet=packed(fitted.gaussians),
        correction=correction,
        losses=fitted.losses,
        steps=fitted.steps,
        status=_start_status(setup, plan.config),
        validation=forecast | correction_entry,
    )


def _start_status(setup: Setup, config: FitConfig) -> str:
    """Return a status about the points that the first frame starts from."""
    if (count := len(setup.points)) >= MIN_POINTS:
        return "ok"
    status = f"the capture has {count} points, too few: seeded {config.first_count} random ones inside the views"
    _LOG.warning("frame 0: %s", status)
    return status


def _first_confidence(
    setup: Setup, state: StreamState, flows: Mapping[int, FlowObservation], rng: np.random.Generator
) -> Gaussians:
    """Return the previous Gaussians; in frame 1 with a confidence learned from the masks of frame 0 (eq. 11).

    The masks of the first frame need the flow to the second one.
    """
    previous, config = state.gaussians, setup.config
    assert previous is not None
    if state.frame != 1 or not flows or not config.motion.learn_confidence:
        return previous
    motion, images = config.motion, state.seen.images
    masks = {
        v: motion_mask(images[v], flow.forward_flow, flow.forward_reliable, motion.mask_method, motion.masks)
        for v, flow in flows.items()
    }
    return fit_confidence(previous, dict(enumerate(setup.cameras)), masks, config.fit, config.render, rng)[0]


def _active_set(
    setup: Setup,
    gaussians: Gaussians,
    images: Images,
    changes: Mapping[int, np.ndarray] | None,
    observations: Mapping[int, Observations],
) -> ActiveSet:
    """Return the Gaussians and pixels that take part in a frame."""
    config = setup.config
    cameras = {v: setup.cameras[v] for v in images}
    if changes is None:
        return full_active_set(gaussians, cameras, config.render)
    channels = {v: channels_of(observations.get(v, {}), config.fit.objective) for v in cameras}
    return find_active_set(gaussians, cameras, changes, channels, config.render, config.motion.active_set)


class StreamLoop:
    """The causal loop as an object: push frames, get packets.

    The packet of a frame is final when `push` returns; no later frame changes it.

    Args:
        cameras: the training views.
        points: SfM points [P, 3], world units; fewer than 20 are replaced by random ones inside the views.
        point_colors: [P, 3], encoded: 1 is white.
        config: settings.
        masks: per view [H, W] bool of valid pixels, or None.
        display_exposure: stops by which images in linear light are brightened where flow and changes are computed,
            which see 8 bits; None: if any light of the first frame exceeds 1, the 99th percentile becomes 1.

    Example:
        >>> loop = morgs_mi.StreamLoop(cameras, points, point_colors)
        >>> for images in frames:  # per frame one image [H, W, 3] per camera: uint8, or linear light in floats
        ...     packet, report = loop.push(images)

    Raises:
        ValueError: no cameras, points that are not finite, colours of another range or shape, or a mask of
            another shape than its view.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        points: np.ndarray,
        point_colors: np.ndarray,
        config: StreamConfig | None = None,
        masks: Sequence[np.ndarray | None] | None = None,
        display_exposure: float | None = None,
    ) -> None:
        self.setup = prepare(cameras, points, point_colors, config, masks, display_exposure)
        self.state = StreamState()
        self._ahead: tuple[int, Future[FrameObservation]] | None = None  # of the next frame, with its index

    @classmethod
    def of(cls, capture: Recorded, config: StreamConfig | None = None) -> StreamLoop:
        """Return the loop of the training views of a capture.

        Args:
            capture: a `Capture`, or another value with its cameras, masks and points.
            config: settings.
        """
        views = capture.train_views
        cameras, masks = [capture.cameras[v] for v in views], [capture.masks[v] for v in views]
        return cls(cameras, capture.points, capture.point_colors, config, masks, capture.display_exposure)

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.state.gaussians

    @interrupts_raised()
    def push(
        self,
        images: Sequence[Given | None],
        progress: Report | None = None,
        upcoming: Sequence[Given | None] | None = None,
        recorded: Sequence[Given | None] | None = None,
        on_provisional: Callable[[Packet], None] | None = None,
    ) -> tuple[Packet, FrameReport]:
        """Fit the next frame and return its packet for the stream, and its report; see `step`.

        Args:
            images: as for `step`.
            progress: as for `step`.
            upcoming: images of the frame after it, if they are there already: their optical flow is computed while
                this frame is fitted. They change nothing else.
            recorded: images with which the next frame's images are compared, if not with `images`: for the first
                frame, where `images` are interpolated because cameras have delays.
            on_provisional: as for `step`.
        """
        start, frame, before = time.perf_counter(), self.state.frame, self.state.seen
        observed = self._observed_ahead(images) or observe_frame(self.setup, frame, before, images)
        seen = observed.seen if recorded is None else see_frame(self.setup, frame, before, recorded)[0]
        if upcoming is not None:
            copies = [None if image is None else np.array(as_array(image)) for image in upcoming]
            self._ahead = frame + 1, in_background(partial(observe_frame, self.setup, frame + 1, seen, copies))
        state, packet, report = step(self.setup, self.state, observed, progress, on_provisional)
        self.state = replace(state, seen=seen)
        return packet, replace(report, seconds=time.perf_counter() - start)

    def _observed_ahead(self, images: Sequence[Given | None]) -> FrameObservation | None:
        """Return the observation made ahead of time, if its images are the same."""
        ahead, self._ahead = self._ahead, None
        if ahead is None or ahead[0] != self.state.frame:
            return None
        observed, given = ahead[1].result(), {v: as_array(image) for v, image in enumerate(images) if image is not None}
        same = given.keys() == observed.recorded.keys()
        return observed if same and all(np.array_equal(given[v], observed.recorded[v]) for v in given) else None

    def resume(
        self,
        coded: CodedFrame,
        frames: Iterable[Sequence[Given | None]],
        exposures: Sequence[Exposure] = (),
    ) -> None:
        """Continue after a frame of a stream, as if it had just been pushed.

        Args:
            coded: state of the stream after that frame.
            frames: images of all frames up to it, as for `push`; the last frame suffices without `skip_static` and
                `exposure`, if they have 8 bits or the display exposure is given.
            exposures: in the report of the first frame.
        """
        seen = Seen()
        for images in frames:
            seen, _ = see_frame(self.setup, coded.frame, seen, images)
        self.state = StreamState(coded.frame + 1, coded, seen, Correction(tuple(exposures)))
        self._ahead = None

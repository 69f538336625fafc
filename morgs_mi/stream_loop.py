"""The causal loop from the frames of fixed cameras to a stream of residuals.

The first frame is reconstructed and written as a keyframe; every later frame is a gated residual
that is guided by the optical flow of a few key views. The mathematics is in `method`, the
optimisation in `fit`. Encoder and decoder cannot drift apart, because the next frame always starts
from the decoded packet.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import CodedFrame, decode, residual_packet
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.core.view import View
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.loop.first_frame import (
    fitted_first_frame,
    warn_of_order,
    with_first_confidence,
)
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.input_images import FrameImages, as_array, image_status, in_order
from morgs_mi.loop.observation import (
    FrameObservation,
    ImageHistory,
    Setup,
    extended_history,
    observe_frame,
    over_border,
    prepare,
)
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.active_set import find_active_set
from morgs_mi.method.exposure import Exposure
from morgs_mi.method.motion import initial_motion
from morgs_mi.method.objective import channels_of, observe
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.platform.checks import quantity
from morgs_mi.platform.interrupts import interrupts_raised
from morgs_mi.platform.memory import FrameBuffers
from morgs_mi.platform.progress import Progress, Report
from morgs_mi.platform.threads import in_background

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class StreamState:
    """State that one frame hands to the next.

    It follows from the stream and the recording, so an interrupted fit can be resumed exactly (see
    `StreamLoop.resume`).
    """

    frame: int = 0  #: Index of the next frame.
    #: State of a decoder after the last frame; None before the first.
    coded: CodedFrame | None = None
    history: ImageHistory = field(default_factory=ImageHistory)  #: Images up to the last frame.
    #: Exposures of all views in the first frame, relative to the scene; empty if they are not
    #: estimated.
    exposures: tuple[Exposure, ...] = ()

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.coded.gaussians if self.coded else None


@interrupts_raised()
def step(
    setup: Setup,
    state: StreamState,
    images: FrameImages | FrameObservation,
    progress: Report | None = None,
    on_provisional: Callable[[Packet], None] | None = None,
) -> tuple[StreamState, Packet, FrameReport]:
    """Fit one frame and return (state, packet, report). The function is pure: all state is
    returned.

    Args:
        setup: data that all frames share, as from `prepare`.
        state: as returned for the last frame; `StreamState()` before the first.
        images: per training view an image [H, W, 3], RGB, or None where the view has none: uint8 in
            sRGB, linear light as a float array or a `mi.TensorXf`, or a `mi.Bitmap`, whose flag
            `srgb_gamma` counts. They are copied. A dict has them by the cameras' names, and so have
            views with images, such as ``frame.train`` of a frame of a capture.
            Alternatively, the result of `observe_frame` for them.
        progress: called with (stage, done, total): the stages of the first frame, or the steps of a
            later one.
        on_provisional: called with provisional keyframes while the first frame is fitted.

    Raises:
        ValueError: an image has another size or type than its camera, or other numbers than the
            images before it (uint8 or floats), floats have 255 for white, or the first frame has no
            image at all.
    """
    start_time = time.perf_counter()
    frame = state.frame
    frame_progress = Progress(progress, f"Frame {frame}")
    observation = images
    if not isinstance(observation, FrameObservation):
        observation = observe_frame(setup, frame, state.history, observation)
    if state.coded is None:
        packet, fitted = fitted_first_frame(setup, observation, frame_progress, on_provisional)
    else:
        packet, fitted = _fit_later_frame(setup, state, observation, frame_progress)
    coded = decode(state.coded, packet)
    problems = image_status([*observation.views.values()])
    if state.coded is None:
        for problem in problems:
            _LOG.warning("frame 0: %s", problem)
    histories = observation.history.views
    report = replace(
        fitted,
        seconds=time.perf_counter() - start_time,
        status="; ".join(filter(None, [*problems, fitted.status])) or "ok",
        missing_views=tuple(
            view.name for v, view in enumerate(setup.views) if v not in observation.views
        ),
        exposures=tuple(
            histories[v].exposure.after(first) if v in histories else first
            for v, first in enumerate(fitted.exposures)
        ),
    )
    return StreamState(frame + 1, coded, observation.history, fitted.exposures), packet, report


def _fit_later_frame(
    setup: Setup, state: StreamState, observation: FrameObservation, progress: Progress
) -> tuple[Packet, FrameReport]:
    """Return the residual of a later frame and the report of its fit; equations are the paper's."""
    assert state.coded is not None
    config = setup.config
    motion = config.motion
    # A new generator for each frame, so that it is no state.
    rng = rng_of(config.seed, Stream.LATER_FRAMES, state.frame)
    previous = state.coded.gaussians
    if state.frame == 1:
        # The masks of frame 0 need the flow to this frame (eqs. 9-11). The confidence is coded with
        # the residual of this frame.
        previous = with_first_confidence(setup, previous, observation.key_views, rng)
    objective = config.fit.objective
    seen_views = observation.views
    active = find_active_set(previous, seen_views, config.render)
    # The optical flow, which is computed beside that.
    key_views = observation.key_views
    observations = {v: observe(view, motion, objective) for v, view in key_views.items()}
    observed = {}
    for view_observations in observations.values():
        observed |= view_observations
    # All channels that are rendered in any view.
    active = active.with_static(previous, channels_of(observed, objective))
    views = {}
    for v, view in active.views.items():
        scene_view = seen_views[v].in_scene(state.exposures)
        target = Target(scene_view.image, scene_view.mask)
        flow = key_views[v].flow if v in key_views else None
        views[v] = ObservedView.of(view, target, observations.get(v), flow)
    # The motion (eq. 5) starts from zero in the paper, and here from lifted flow and proposals.
    start = initial_motion(previous, active, views, motion, rng)
    problem = FrameProblem(previous, active, views, start, setup.extent)
    # Residual (eqs. 6-8, 12) and objective (eq. 13).
    fitted = fit_later_frame(problem, config.fit, motion, rng, progress)
    # The next frame starts from what a decoder reads (eq. 3).
    coder = config.codec
    packet = residual_packet(state.coded, fitted.gaussians, fitted.source, setup.cameras, coder)
    report = FrameReport(
        frame=state.frame,
        seconds=0.0,
        num_bytes=packet.num_bytes,
        losses=fitted.losses,
        num_gaussians=len(fitted.gaussians),
        psnr=fitted.psnr,
        status=fitted.problem if seen_views else "no view has an image",
        active=active.fractions,
        steps=fitted.steps,
        exposures=state.exposures,
    )
    return packet, report


class StreamLoop:
    """The causal loop as an object: push frames, get packets.

    The packet of a frame is final when `push` returns; no later frame changes it.

    Args:
        views: the training views: `View`s, which may have a mask, or cameras.
        points: SfM points [P, 3], world units; fewer than 20, or points of which the cameras see
            less than 5 %, are replaced as by `fit_gaussians`, and the background is the colour that
            the borders of the first images have in common, unless one is given.
        point_colors: [P, 3], encoded: 1 is white.
        config: settings.
        display_exposure: exposure in stops at which images in linear light are converted to 8 bits
            for optical flow and the detection of changes; losses do not depend on it. None: 0 if no
            light of the first frame exceeds 1, otherwise the 99th percentile becomes white.

    Example:
        >>> loop = morgs_mi.StreamLoop(views, points, point_colors)
        >>> for images in frames:  # an image [H, W, 3] per view: uint8, or linear light
        ...     packet, report = loop.push(images)

    Raises:
        ValueError: no views, points that are not finite, colours of another range or shape, or a
            mask of another shape than its view.
    """

    def __init__(
        self,
        views: Sequence[View | Camera],
        points: np.ndarray,
        point_colors: np.ndarray,
        config: StreamConfig | None = None,
        display_exposure: float | None = None,
    ) -> None:
        self.setup = prepare(views, points, point_colors, config, display_exposure)
        self.state = StreamState()
        # Index and pending observation of the next frame.
        self._next_observation: tuple[int, Future[FrameObservation]] | None = None
        self._buffers = FrameBuffers()
        # Whether images in a list may be in another order than the cameras.
        self._can_mistake_order = True

    @classmethod
    def of(cls, capture: Any, config: StreamConfig | None = None) -> StreamLoop:
        """Return the loop of the training views of a capture.

        Args:
            capture: a `Capture`, or another value with its views, points, point_colors and
                display_exposure.
            config: settings.
        """
        loop = cls(
            capture.views.train,
            capture.points,
            capture.point_colors,
            config,
            capture.display_exposure,
        )
        loop._can_mistake_order = False
        return loop

    def __repr__(self) -> str:
        cameras = quantity(len(self.setup.views), "camera")
        gaussians = "" if self.gaussians is None else f", {self.gaussians}"
        return f"StreamLoop({cameras}, frame {self.state.frame} is next{gaussians})"

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.state.gaussians

    @interrupts_raised()
    def push(
        self,
        images: FrameImages,
        progress: Report | None = None,
        upcoming: FrameImages | None = None,
        recorded: FrameImages | None = None,
        on_provisional: Callable[[Packet], None] | None = None,
    ) -> tuple[Packet, FrameReport]:
        """Fit the next frame and return its packet for the stream, and its report; see `step`.

        Args:
            images: as for `step`.
            progress: as for `step`.
            upcoming: images of the frame after it, if they are there already: their optical flow is
                computed while this frame is fitted. They change nothing else.
            recorded: images with which the next frame is compared for flow and changes; None:
                `images`. They differ in a first frame whose `images` are interpolated to one
                timestamp, because cameras have delays.
            on_provisional: as for `step`.
        """
        start_time = time.perf_counter()
        frame = self.state.frame
        previous = self.state.history
        if not frame:
            self.setup = over_border(self.setup, images)
        observation = self._observation_ahead(images)
        if observation is None:
            observation = observe_frame(self.setup, frame, previous, images)
        history = observation.history
        if not frame and self._can_mistake_order:
            warn_of_order(images, observation)
        if recorded is not None:
            history = extended_history(self.setup, frame, previous, recorded)
        if upcoming is not None:  # beside the fit, which starts below
            ahead = in_order(self.setup.views, upcoming, frame + 1)
            copies = [None if image is None else np.array(as_array(image)) for image in ahead]
            observe_next = partial(observe_frame, self.setup, frame + 1, history, copies)
            self._next_observation = frame + 1, in_background(observe_next)
        state, packet, report = step(self.setup, self.state, observation, progress, on_provisional)
        self.state = replace(state, history=history)
        memory = self._buffers.end_frame(frame, report.active.get("pixels", 0.0))
        return packet, replace(report, seconds=time.perf_counter() - start_time, memory=memory)

    def _observation_ahead(self, images: FrameImages) -> FrameObservation | None:
        """Return the observation that was made ahead of time if its images are the same; it is used
        once.
        """
        task = self._next_observation
        self._next_observation = None
        if task is None or task[0] != self.state.frame:
            return None
        observation = task[1].result()
        ordered = in_order(self.setup.views, images, self.state.frame)
        return observation if observation.is_of(ordered) else None

    def resume(
        self,
        coded: CodedFrame,
        frames: Iterable[FrameImages],
        exposures: Sequence[Exposure] = (),
    ) -> None:
        """Continue after a frame of a stream, as if it had just been pushed.

        Args:
            coded: state of the stream after that frame.
            frames: images of all frames up to it, as for `push`. The last frame suffices if
                `fit.skip_static` is off, `fit.exposure` is "off", and the images have 8 bits or
                `display_exposure` is given.
            exposures: `FrameReport.exposures` of the first frame.
        """
        history = ImageHistory()
        for images in frames:
            if not history.views:
                self.setup = over_border(self.setup, images)
            history = extended_history(self.setup, coded.frame, history, images)
        self.state = StreamState(coded.frame + 1, coded, history, tuple(exposures))
        self._next_observation = None

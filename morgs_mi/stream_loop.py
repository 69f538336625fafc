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
from dataclasses import asdict, dataclass, field, replace
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
from morgs_mi.fit.balance import Balance, balance_cameras, balance_config
from morgs_mi.fit.budget import plan_first_frame
from morgs_mi.fit.dropping import adapted_to_images
from morgs_mi.fit.first_frame import fit_confidence, fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import MIN_POINTS
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.fit.unseen_views import unseen_views
from morgs_mi.fit.view import View
from morgs_mi.loop.image_status import image_status
from morgs_mi.loop.observation import FrameObservation, Images, Recorded, Seen, Setup, observe_frame, prepare, see_frame
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
        balance: exposures of the first frame, by view; empty if they are not estimated.
    """

    frame: int = 0
    coded: CodedFrame | None = None
    seen: Seen = field(default_factory=Seen)
    balance: tuple[Exposure, ...] = ()

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.coded.gaussians if self.coded else None


@interrupts_raised()
def step(
    setup: Setup,
    state: StreamState,
    images: Sequence[np.ndarray | None] | FrameObservation,
    progress: Report | None = None,
    on_provisional: Callable[[Packet], None] | None = None,
) -> tuple[StreamState, Packet, FrameReport]:
    """Fit one frame and return (state, packet, report). The function is pure: all state is returned.

    Args:
        setup: data that all frames share, as from `prepare`.
        state: as returned for the last frame; `StreamState()` before the first.
        images: per training view uint8 [H, W, 3], RGB, or None where the view has no image. They are copied.
            Alternatively, the result of `observe_frame` for them.
        progress: called with (stage, done, total): the stages of the first frame, or the steps of a later one.
        on_provisional: called with provisional keyframes while the first frame is fitted.

    Raises:
        ValueError: an image has another size or type than its camera, or the first frame has no image at all.
    """
    start, observed = time.perf_counter(), images
    if not isinstance(observed, FrameObservation):
        observed = observe_frame(setup, state.frame, state.seen, observed)
    fit = partial(_fit_first_frame, on_provisional) if state.coded is None else _fit_later_frame
    packet, about = fit(setup, state, observed, Progress(progress, f"Frame {state.frame}"))
    coded, seen = decode(state.coded, packet), observed.seen
    balance = about.pop("balance", state.balance)
    about["status"] = _status(setup, state, seen.images, about["status"])
    report = FrameReport(
        state.frame,
        time.perf_counter() - start,
        packet.num_bytes,
        num_gaussians=len(coded),
        missing_views=tuple(camera.name for v, camera in enumerate(setup.cameras) if v not in seen.images),
        exposures=tuple(seen.exposures.get(v, Exposure()).after(first) for v, first in enumerate(balance)),
        **about,
    )
    return StreamState(state.frame + 1, coded, seen, balance), packet, report


def _status(setup: Setup, state: StreamState, images: Images, status: str) -> str:
    """Return the status of a frame with the problems of its images, which are logged in the first frame."""
    problems = image_status([camera.name for camera in setup.cameras], state.seen.images, images)
    for problem in problems if state.coded is None else ():
        _LOG.warning("frame 0: %s", problem)
    return "; ".join([*([] if status == "ok" else [status]), *problems]) or "ok"


def _fit_later_frame(
    setup: Setup, state: StreamState, observed: FrameObservation, progress: Progress
) -> tuple[Packet, dict[str, Any]]:
    """Return a later frame's packet and the entries of its report; numbers refer to the paper's equations."""
    assert state.coded is not None
    config, motion, images, flows = setup.config, setup.config.motion, observed.seen.images, observed.flows
    rng = rng_of(config.seed, Stream.LATER_FRAMES, state.frame)  # of its own for each frame: it is no state
    previous = _first_confidence(setup, state, flows, rng)  # frame 0's confidence (11)
    observations = observe(observed.key_views, motion, config.fit.objective)
    active = _active_set(setup, previous, images, observed.changes, observations)
    balanced = _balanced({view: images[view] for view in active.views}, state.balance)
    targets = {view: Target(image, setup.masks[view]) for view, image in balanced.items()}
    initial = initial_motion(previous, active, flows, targets, motion, rng)  # motion (5)
    problem = FrameProblem(previous, active, targets, observations, initial, setup.extent)
    fitted = fit_later_frame(problem, config.fit, motion, rng, progress)  # residual (6-8, 12), objective (13)
    packet = residual_packet(state.coded, fitted.gaussians, fitted.source, setup.cameras, config.codec)  # (3)
    return packet, {
        "losses": fitted.losses,
        "status": "ok" if images else "no view has an image",
        "active": {**active.fractions, "epochs": fitted.epochs / config.fit.epochs},
        "steps": fitted.epochs * len(active.views),
    }


def _fit_first_frame(
    on_provisional: Callable[[Packet], None] | None,
    setup: Setup,
    state: StreamState,
    observed: FrameObservation,
    progress: Progress,
) -> tuple[Packet, dict[str, Any]]:
    """Return the first frame's packet and the entries of its report."""
    config, images = setup.config, observed.seen.images
    found = _balance(setup, images, progress)
    balance = _exposures_of(setup, images, found)
    views, rng = _views(setup, _balanced(images, balance)), rng_of(config.seed, Stream.FIRST_FRAME)
    plan = plan_first_frame(views, setup.points, config.fit)
    problem = FirstFrameProblem.of(views, setup.cloud, plan.config, config.render, rng)
    fit_config = adapted_to_images(plan.config, problem)

    def packed(gaussians: Gaussians) -> Packet:
        return keyframe_packet(gaussians, 0, setup.cameras, config.codec)

    on_round = None if on_provisional is None else lambda gaussians: on_provisional(packed(gaussians))
    fitted = fit_first_frame(problem, fit_config, rng, progress.of(plan.stage), on_round)
    return packed(fitted.gaussians), {
        "losses": fitted.losses,
        "status": _start_status(setup, plan.config),
        "validation": _about_unseen_views(problem, fitted.gaussians) | _about_balance(found),
        "steps": fitted.steps,
        "balance": balance,
    }


def _views(setup: Setup, images: Images) -> list[View]:
    """Return the views that have an image."""
    return [View(setup.cameras[v], image, setup.masks[v]) for v, image in images.items()]


def _start_status(setup: Setup, config: FitConfig) -> str:
    """Return a status about the points that the first frame starts from."""
    if (count := len(setup.points)) >= MIN_POINTS:
        return "ok"
    status = f"the capture has {count} points, too few: seeded {config.first_count} random ones inside the views"
    _LOG.warning("frame 0: %s", status)
    return status


def _balance(setup: Setup, images: Images, progress: Progress) -> Balance | None:
    """Return the balance of the cameras in the first frame; None if it is not estimated, or of a single view."""
    config = setup.config
    if config.fit.exposure == "off" or len(images) < 2:
        return None
    rng, short = rng_of(config.seed, Stream.BALANCED_POINTS), balance_config(config.fit)
    problem = FirstFrameProblem.of(_views(setup, images), setup.cloud, short, config.render, rng)
    return balance_cameras(problem, config.fit, config.seed, progress)


def _exposures_of(setup: Setup, images: Images, found: Balance | None) -> tuple[Exposure, ...]:
    """Return the exposure of each view in the first frame: none of one without an image; empty if not estimated."""
    if setup.config.fit.exposure == "off":
        return ()
    known = dict(zip(images, found.exposures, strict=True)) if found is not None and found.taken else {}
    return tuple(known.get(v, Exposure()) for v in range(len(setup.cameras)))


def _balanced(images: Images, balance: Sequence[Exposure]) -> dict[int, np.ndarray]:
    """Return images in the colours of the scene, which all views share."""
    return {v: balance[v].corrected(image) if balance else image for v, image in images.items()}


def _about_unseen_views(problem: FirstFrameProblem, gaussians: Gaussians) -> dict[str, Any]:
    """Return the entries of the first frame's report on views between the cameras."""
    if len(problem.views) < 2:
        return {}
    forecast = unseen_views(problem, gaussians)
    figures = {"quality": forecast.quality, "expected_psnr": forecast.expected_psnr, "interval": forecast.interval}
    return {"sentence": forecast.sentence, **figures, **asdict(forecast)}


def _about_balance(found: Balance | None) -> dict[str, Any]:
    """Return the entries of the first frame's report on the balance of the cameras."""
    if found is None:
        return {}
    scores = {"recorded_psnr": found.recorded_psnr, "balanced_psnr": found.balanced_psnr}
    return {"exposure": {"sentence": found.sentence, "taken": found.taken, **scores}}


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
        point_colors: [P, 3] in [0, 1].
        config: settings.
        masks: per view [H, W] bool of valid pixels, or None.

    Example:
        >>> loop = morgs_mi.StreamLoop(cameras, points, point_colors)
        >>> for images in frames:  # per frame one uint8 image [H, W, 3] per camera
        ...     packet, report = loop.push(images)

    Raises:
        ValueError: no cameras, points that are not finite, colours outside [0, 1] or of another shape, or a mask of
            another shape than its view.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        points: np.ndarray,
        point_colors: np.ndarray,
        config: StreamConfig | None = None,
        masks: Sequence[np.ndarray | None] | None = None,
    ) -> None:
        self.setup = prepare(cameras, points, point_colors, config, masks)
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
        return cls(cameras, capture.points, capture.point_colors, config, masks)

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.state.gaussians

    @interrupts_raised()
    def push(
        self,
        images: Sequence[np.ndarray | None],
        progress: Report | None = None,
        upcoming: Sequence[np.ndarray | None] | None = None,
        recorded: Sequence[np.ndarray | None] | None = None,
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
            copies = [None if image is None else np.array(image) for image in upcoming]
            self._ahead = frame + 1, in_background(partial(observe_frame, self.setup, frame + 1, seen, copies))
        state, packet, report = step(self.setup, self.state, observed, progress, on_provisional)
        self.state = replace(state, seen=seen)
        return packet, replace(report, seconds=time.perf_counter() - start)

    def _observed_ahead(self, images: Sequence[np.ndarray | None]) -> FrameObservation | None:
        """Return the observation made ahead of time, if its images are the same."""
        ahead, self._ahead = self._ahead, None
        if ahead is None or ahead[0] != self.state.frame:
            return None
        observed, given = ahead[1].result(), {v: image for v, image in enumerate(images) if image is not None}
        same = given.keys() == observed.recorded.keys()
        return observed if same and all(np.array_equal(given[v], observed.recorded[v]) for v in given) else None

    def resume(
        self,
        coded: CodedFrame,
        frames: Iterable[Sequence[np.ndarray | None]],
        balance: Sequence[Exposure] = (),
    ) -> None:
        """Continue after a frame of a stream, as if it had just been pushed.

        Args:
            coded: state of the stream after that frame.
            frames: images of all frames up to it, as for `push`; the last frame suffices without `skip_static` and
                `exposure`.
            balance: exposures in the report of the first frame.
        """
        seen = Seen()
        for images in frames:
            seen, _ = see_frame(self.setup, coded.frame, seen, images)
        self.state, self._ahead = StreamState(coded.frame + 1, coded, seen, tuple(balance)), None

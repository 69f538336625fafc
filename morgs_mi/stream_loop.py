"""The causal loop from the frames of fixed cameras to a stream of residuals.

The first frame is reconstructed and written as a keyframe; every later frame is a gated residual that is guided by the
optical flow of a few key views. The mathematics is in `method`, the optimisation in `fit`. The next frame always starts
from the decoded packet, so that encoder and decoder cannot drift apart.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import CodedFrame, decode, keyframe_packet, residual_packet
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import check_mask, check_points, check_type
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.threads import map_in_threads
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import mean_psnr
from morgs_mi.fit.detail import gaussians_for
from morgs_mi.fit.first_frame import fit_confidence, fit_first_frame
from morgs_mi.fit.first_settings import Expected, first_settings
from morgs_mi.fit.forecast import Forecast
from morgs_mi.fit.initialise import fill_points, from_points, resample_points, scene_extent, seed_points
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import ActiveSet, find_active_set, full_active_set
from morgs_mi.method.change import box_around, change_mask, moving_region, update_reference
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.flow import FlowObservation, choose_key_views, observe_key_views
from morgs_mi.method.flow_sources.registry import FramePair
from morgs_mi.method.motion import initial_motion
from morgs_mi.method.objective import KeyView, Observations, channels_of, observe

__all__ = ["FrameReport", "Setup", "StreamLoop", "StreamState", "prepare", "step"]

_LOG = logging.getLogger(__name__)

# With fewer points, the first frame starts from random ones inside the views; with less than `_MANY_POINTS`, some are
# added where views show none.
_MIN_POINTS, _MANY_POINTS = 20, 1000

# By view index: the images of those views that have one.
Images = Mapping[int, np.ndarray]


@dataclass(frozen=True)
class FrameReport:
    """Report of one frame.

    Attributes:
        frame: its index.
        seconds: wall time from the images to the packet, optical flow and optimisation included.
        num_bytes: size of the packet in the stream.
        losses: means over the last steps, by the names of the terms.
        num_gaussians: number of Gaussians of the frame.
        status: "ok", or a sentence about what was done instead.
        missing_views: names of the views without an image.
        active: what took part, as fractions of everything, by name: gaussians, views, pixels, epochs.
        validation: of the first frame, a `sentence` on views between the cameras and their `expected_psnr` in dB, with
            the results of cross-validation (see `fit.cross_validation`) and the comparison of two fits (see
            `fit.agreement`), or else the forecast (see `fit.forecast`), which has no number; empty with a single view.
        steps: number of optimisation steps, without those of trials.
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


@dataclass(frozen=True, eq=False)
class StreamState:
    """State that one frame hands to the next.

    It follows from the stream and the recording, so that an interrupted fit can be resumed exactly (see `recorder`).

    Attributes:
        frame: index of the next frame.
        coded: state of a decoder after the last frame; None before the first.
        images: images of the last frame, by view index, of the views that had one.
        references: images that the next frame is compared with to detect changes, by view index.
    """

    frame: int = 0
    coded: CodedFrame | None = None
    images: Images = field(default_factory=dict)
    references: Images = field(default_factory=dict)

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.coded.gaussians if self.coded else None


@dataclass(frozen=True, eq=False)
class Setup:
    """What all frames share; made by `prepare`.

    Attributes:
        cameras: the V training views.
        masks: per view [H, W] bool of valid pixels, or None.
        points: SfM points [P, 3], world units.
        point_colors: [P, 3] in [0, 1].
        key_views: indices of the views with optical flow and masks.
        extent: of the scene, world units.
        config: settings.
    """

    cameras: tuple[Camera, ...]
    masks: tuple[np.ndarray | None, ...]
    points: np.ndarray
    point_colors: np.ndarray
    key_views: tuple[int, ...]
    extent: float
    config: StreamConfig


def step(
    setup: Setup,
    state: StreamState,
    images: Sequence[np.ndarray | None],
    on_step: Callable[[int, int], None] | None = None,
) -> tuple[StreamState, Packet, FrameReport]:
    """Fit one frame and return (state, packet, report). The function is pure: all state is in what it returns.

    Args:
        setup: what all frames share, as from `prepare`.
        state: as returned for the last frame; `StreamState()` before the first.
        images: per training view uint8 [H, W, 3], RGB, or None where the view has no image. They are copied.
        on_step: called with (steps done, steps of this frame).

    Raises:
        ValueError: an image has another size or type than its camera, or the first frame has no image at all.
    """
    seen = _copies(setup.cameras, images, state.frame)
    if state.coded is None:
        return _first_step(setup, state, seen, on_step)
    return _later_step(setup, state, seen, on_step)


def _later_step(
    setup: Setup, state: StreamState, images: Images, on_step: Callable[[int, int], None] | None
) -> tuple[StreamState, Packet, FrameReport]:
    """Fit a later frame, see `step`; the numbers are those of the paper's equations."""
    assert state.coded is not None
    start, config, motion = time.perf_counter(), setup.config, setup.config.motion
    rng = np.random.default_rng([config.seed, state.frame])  # of its own for each frame, so that it is no state
    changes = _changes(setup, state.references, images)
    flows, key_views = _observe(setup, state, images, changes)  # flow (4), masks (9, 10)
    previous = _first_confidence(setup, state, flows, rng)  # frame 0's confidence (11)
    observations = observe(key_views, motion, config.fit.objective)
    active = _active_set(setup, previous, images, changes, observations)
    targets = {view: Target(images[view], setup.masks[view]) for view in active.views}
    initial = initial_motion(previous, active, flows, targets, motion, rng)  # motion (5)
    problem = FrameProblem(previous, active, targets, observations, initial, setup.extent)
    fitted = fit_later_frame(problem, config.fit, motion, rng, on_step)  # residual (6-8, 12), objective (13)
    packet = residual_packet(state.coded, fitted.gaussians, fitted.source, setup.cameras, config.codec)  # (3)
    coded = decode(state.coded, packet)
    report = FrameReport(
        state.frame,
        time.perf_counter() - start,
        packet.num_bytes,
        fitted.losses,
        len(coded),
        "ok" if images else "no view has an image",
        _missing(setup, images),
        {**active.fractions, "epochs": fitted.epochs / config.fit.epochs},
        steps=fitted.epochs * len(active.views),
    )
    return StreamState(state.frame + 1, coded, images, _references(setup, state, images, changes)), packet, report


def _first_step(
    setup: Setup, state: StreamState, images: Images, on_step: Callable[[int, int], None] | None
) -> tuple[StreamState, Packet, FrameReport]:
    """Fit the first frame, see `step`."""
    start, config = time.perf_counter(), setup.config
    rng = np.random.default_rng([config.seed, 0])
    cameras, masks = [setup.cameras[v] for v in images], [setup.masks[v] for v in images]
    fit = config.fit
    if fit.num_gaussians is None:
        count = gaussians_for(cameras, list(images.values()), masks, setup.points, fit.detail)
        fit = replace(fit, num_gaussians=count)
    gaussians, status = _first_gaussians(setup, images, fit, rng)
    targets = [Target(image, mask) for image, mask in zip(images.values(), masks, strict=True)]
    given = gaussians, cameras, list(images.values()), masks, targets, setup.points, setup.extent
    chosen = first_settings(*given, fit, config.render, [config.seed, 0, 1], on_step)
    before = chosen.steps_before
    tick = None if on_step is None else lambda done, steps: on_step(before + done, before + steps)
    fitted = fit_first_frame(gaussians, cameras, targets, setup.extent, chosen.config, config.render, rng, tick)
    views = list(zip(cameras, images.values(), masks, strict=True))
    own = mean_psnr(fitted.gaussians, views, config.render) if chosen.steps_before else 0.0
    expected = [replace(e, training_psnr=own) if not isinstance(e, Forecast) else e for e in chosen.expected]
    packet = keyframe_packet(fitted.gaussians, 0, setup.cameras, config.codec)
    coded = decode(None, packet)
    report = FrameReport(
        0,
        time.perf_counter() - start,
        packet.num_bytes,
        fitted.losses,
        len(coded),
        status,
        _missing(setup, images),
        validation=_described(expected) if expected else {},
        steps=fitted.steps,
    )
    return StreamState(1, coded, images, _references(setup, state, images, {})), packet, report


def _described(expected: Sequence[Expected]) -> dict[str, Any]:
    """Return what to expect of views between the cameras, as in the report.

    An estimate errs on the low side, as a rig without some views is another rig and a short fit is less certain. So the
    highest one counts.
    """
    best = max(expected, key=lambda found: found.expected_psnr or 0.0)
    found = {name: value for each in expected for name, value in asdict(each).items()}
    return {"sentence": best.sentence, "expected_psnr": best.expected_psnr, **found}


def _first_gaussians(setup: Setup, seen: Images, config: FitConfig, rng: np.random.Generator) -> tuple[Gaussians, str]:
    """Return the initial Gaussians, and a status about where they lie."""
    status = "ok"
    count, images = config.first_count, list(seen.values())
    cameras, masks = [setup.cameras[v] for v in seen], [setup.masks[v] for v in seen]
    points, colors = setup.points, setup.point_colors
    if len(points) < _MIN_POINTS:
        status = f"the capture has {len(points)} points, too few: seeded {count} random ones inside the views"
        _LOG.warning("frame 0: %s", status)
        points, colors = seed_points(cameras, images, masks, count, rng)
    elif len(points) < _MANY_POINTS:
        points, colors = fill_points(points, colors, cameras, images, masks, count, rng)
    points, colors = resample_points(points, colors, count, rng)
    return from_points(points, colors, config.sh_degree, config.initial_opacity), status


def _changes(setup: Setup, references: Images, images: Images) -> dict[int, np.ndarray] | None:
    """Return the masks of changed pixels [H, W], by view index; None: all pixels may have changed."""
    if not setup.config.fit.skip_static:
        return None
    nothing = {v: np.zeros(image.shape[:2], bool) for v, image in images.items()}  # where it is the view's first image
    config = setup.config.motion.change
    known = sorted(images.keys() & references.keys())
    masks = map_in_threads(lambda v: change_mask(references[v], images[v], setup.masks[v], config), known)
    return nothing | dict(zip(known, masks, strict=True))


def _references(
    setup: Setup, state: StreamState, images: Images, changes: Mapping[int, np.ndarray] | None
) -> dict[int, np.ndarray]:
    """Return the images that the next frame is compared with."""
    if not setup.config.fit.skip_static or changes is None:
        return {}
    known = images.keys() & state.references.keys()
    return {**state.references, **images} | {
        v: update_reference(state.references[v], images[v], changes[v]) for v in known
    }


def _observe(
    setup: Setup, state: StreamState, images: Images, changes: Mapping[int, np.ndarray] | None
) -> tuple[dict[int, FlowObservation], dict[int, KeyView]]:
    """Return the optical flow of the key views that changed, with masks in every n-th frame, where a term uses it."""
    motion = setup.config.motion
    with_masks = motion.learn_confidence and state.frame % motion.mask_interval == 0
    if not (motion.learn_motion or with_masks or (motion.learn_confidence and state.frame == 1)):
        return {}, {}
    pairs = {}
    for v in _frame_key_views(setup, state, images):
        box = None if changes is None else box_around(changes[v], motion.change)
        if changes is None or box is not None:
            region = None if changes is None else moving_region(changes[v], motion.change)
            name, valid = setup.cameras[v].name, setup.masks[v]
            pairs[v] = FramePair(images[v], state.images[v], name, state.frame, valid, box, region)
    masks = motion.mask_method if with_masks else None
    flows = observe_key_views(pairs, motion.flow_method, masks, motion.flow, motion.masks)
    return flows, {v: KeyView(pairs[v], flow) for v, flow in flows.items()}


def _frame_key_views(setup: Setup, state: StreamState, images: Images) -> tuple[int, ...]:
    """Return the key views of a frame: those of the setup, with others in place of those that lack an image."""
    both = sorted(state.images.keys() & images.keys())
    key_views = tuple(v for v in setup.key_views if v in both)
    if len(key_views) == len(setup.key_views) or not both:
        return key_views
    return tuple(both[k] for k in choose_key_views([setup.cameras[v] for v in both], len(setup.key_views)))


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
    how = config.motion.mask_method, config.motion.masks
    masks = {v: motion_mask(state.images[v], f.forward_flow, f.forward_reliable, *how) for v, f in flows.items()}
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


def _missing(setup: Setup, images: Images) -> tuple[str, ...]:
    return tuple(camera.name for view, camera in enumerate(setup.cameras) if view not in images)


def _copies(cameras: Sequence[Camera], images: Sequence[np.ndarray | None], frame: int) -> dict[int, np.ndarray]:
    """Return copies of the images of those views that have one, by view index, if all have their camera's size."""
    _check_images(cameras, images, frame)
    return {view: image.copy() for view, image in enumerate(images) if image is not None}


def _check_images(cameras: Sequence[Camera], images: Sequence[np.ndarray | None], frame: int) -> None:
    count = len(images) if isinstance(images, (Sequence, np.ndarray)) else f"a {type(images).__name__}"
    if count != len(cameras):
        raise ValueError(
            f"step(): frame {frame} must have one image or None for each of {len(cameras)} views, got {count}."
        )
    if not frame and all(image is None for image in images):
        raise ValueError("step(): frame 0 must have an image of at least one view, got none; begin with one that has.")
    for view, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        shape = camera.height, camera.width, 3
        if image is not None and (not isinstance(image, np.ndarray) or (image.shape, image.dtype) != (shape, np.uint8)):
            found = f"{image.dtype} {list(image.shape)}" if isinstance(image, np.ndarray) else type(image).__name__
            raise ValueError(
                f"step(): frame {frame} of view {camera.name or view!r} must be uint8 {list(shape)}, got {found}; "
                "convert it."
            )


def prepare(
    cameras: Sequence[Camera],
    points: np.ndarray,
    point_colors: np.ndarray,
    config: StreamConfig | None = None,
    masks: Sequence[np.ndarray | None] | None = None,
) -> Setup:
    """Return what all frames share; arguments and errors are those of `StreamLoop`."""
    config = StreamConfig() if config is None else config
    check_type("StreamLoop()", "config", config, StreamConfig)
    if not isinstance(cameras, Sequence) or not cameras:
        found = f"a {type(cameras).__name__}" if cameras else "none"
        raise ValueError(f"StreamLoop(): `cameras` must be a sequence of at least one view, got {found}; pass a list.")
    for camera in cameras:
        check_type("StreamLoop()", "cameras", camera, Camera)
    points, point_colors = check_points("StreamLoop()", points, point_colors)
    masks = (None,) * len(cameras) if masks is None else masks
    if len(masks) != len(cameras):
        raise ValueError(
            f"StreamLoop(): `masks` must have one mask or None for each of {len(cameras)} views, got {len(masks)}; "
            "pass None where all pixels are valid."
        )
    for view, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        if mask is not None:
            check_mask(f"StreamLoop(): view {camera.name or view!r}", mask, camera.height, camera.width)
    copies = tuple(None if mask is None else mask.copy() for mask in masks)
    key_views = choose_key_views(cameras, config.motion.key_views)
    extent = scene_extent(cameras)
    return Setup(tuple(cameras), copies, points.copy(), point_colors.copy(), key_views, extent, config)


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

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.state.gaussians

    def push(
        self, images: Sequence[np.ndarray | None], on_step: Callable[[int, int], None] | None = None
    ) -> tuple[Packet, FrameReport]:
        """Fit the next frame and return its packet for the stream, and its report; see `step`."""
        self.state, packet, report = step(self.setup, self.state, images, on_step)
        return packet, report

    def resume(self, coded: CodedFrame, frames: Iterable[Sequence[np.ndarray | None]]) -> None:
        """Continue after a frame of a stream, as if it had just been pushed.

        Args:
            coded: state of the stream after that frame.
            frames: images of all frames up to it, as for `push`; the last frame suffices without `skip_static`.
        """
        state = StreamState()
        for images in frames:
            seen = _copies(self.setup.cameras, images, coded.frame)
            changes = _changes(self.setup, state.references, seen)
            state = StreamState(coded.frame + 1, coded, seen, _references(self.setup, state, seen, changes))
        self.state = state

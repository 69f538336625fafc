"""Door B: the causal loop that turns the frames of fixed cameras into a stream of residuals.

It reads like the method: the first frame is reconstructed, its confidence is learned from the second; every
later frame is a gated residual guided by the flow of a few key views. The mathematics is in `motion/` and
`fit/`. What the next frame starts from is always the decoded packet, so encoder and decoder cannot drift.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from morgs_mi.codec.container import Packet, encode_packet
from morgs_mi.codec.packets import CodedFrame, decode, keyframe_packet, residual_packet
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.first_frame import fit_confidence, fit_first_frame
from morgs_mi.fit.initialise import from_points, resample_points, scene_extent, seed_points
from morgs_mi.fit.later_frame import fit_later_frame
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import ActiveSet, find_active_set, full_active_set
from morgs_mi.method.change import around, changed, renewed
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.flow import FlowObservation, choose_key_views, observe_key_views
from morgs_mi.method.flow_sources.registry import FramePair

__all__ = ["MIN_POINTS", "FrameReport", "StreamLoop", "StreamState", "step"]

_LOG = logging.getLogger(__name__)

# Fewer points than this are no scene: random points in the views are the better start.
MIN_POINTS = 100


@dataclass(frozen=True)
class FrameReport:
    """What happened at one frame.

    Attributes:
        frame: its index.
        seconds: wall time from the pictures to the packet, optimisation and flow included.
        num_bytes: size of the packet in the stream.
        losses: means over the last steps, by name.
        num_gaussians: how many the frame has.
        status: "ok", or a sentence about what was done instead.
        left_out: names of the views that had no picture.
        effort: what the frame worked on, as shares of everything, by name: Gaussians, views, their pixels, epochs.
    """

    frame: int
    seconds: float
    num_bytes: int
    losses: dict[str, float]
    num_gaussians: int
    status: str = "ok"
    left_out: tuple[str, ...] = ()
    effort: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class StreamState:
    """What one frame leaves to the next.

    Attributes:
        frame: index of the next frame.
        coded: what a decoder has after the last frame; None before the first.
        images: the pictures of the last frame, None where a view had none.
        references: what the next pictures are compared with to find what has changed; None before the first.

    Nothing else crosses frames, and all of it follows from the stream and the recording, so that a fit that was
    interrupted goes on as if it had not been (`recorder`).
    """

    frame: int
    coded: CodedFrame | None
    images: tuple[np.ndarray | None, ...]
    references: tuple[np.ndarray | None, ...] = ()

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame."""
        return self.coded.gaussians if self.coded else None


@dataclass(frozen=True, eq=False)
class Setup:
    """What all frames share: the training views, the points of the first frame, and the settings."""

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
    images: Sequence[np.ndarray],
    on_step: Callable[[int, int], None] | None = None,
) -> tuple[StreamState, Packet, FrameReport]:
    """Take in one frame of all views of `setup` and return (state, packet, report)."""
    start = time.perf_counter()
    config, render = setup.config.fit, setup.config.render
    rng = np.random.default_rng([setup.config.seed, state.frame])  # a frame's own: it needs no state
    if state.coded is None:
        targets = [Target(image, mask) for image, mask in zip(images, setup.masks, strict=True)]
        gaussians, status = _first_gaussians(setup, images, rng)
        tick = None if on_step is None else lambda done: on_step(done, config.first_frame_steps)
        gaussians, losses = fit_first_frame(gaussians, setup.cameras, targets, setup.extent, config, render, rng, tick)
        packet = keyframe_packet(gaussians, state.frame, setup.cameras, setup.config.codec)
        decoded, effort = decode(None, packet), {}
    else:
        previous, status = state.coded.gaussians, "ok"
        changes = _changes(setup, state, images)
        cues = _cues(setup, state, images, changes)
        if state.frame == 1 and cues and setup.config.motion.learn_confidence:
            previous = _first_confidence(setup, state, cues, rng)
        part = _part(setup, previous, changes)
        targets = {view: Target(images[view], setup.masks[view]) for view in part.views}
        fitted = fit_later_frame(previous, part, targets, cues, setup.extent, config, setup.config.motion, rng, on_step)
        packet = residual_packet(state.coded, fitted.gaussians, fitted.source, setup.cameras, setup.config.codec)
        decoded, losses = decode(state.coded, packet), fitted.losses
        effort = {**part.fractions, "epochs": fitted.epochs / config.epochs}
    seconds = time.perf_counter() - start
    report = FrameReport(state.frame, seconds, len(encode_packet(packet)), losses, len(decoded), status, effort=effort)
    return StreamState(state.frame + 1, decoded, tuple(images)), packet, report


def _changes(setup: Setup, state: StreamState, images: Sequence[np.ndarray]) -> list[np.ndarray] | None:
    """Return what has changed in each view; None: everything may have."""
    if not setup.config.fit.skip_static:
        return None
    # What has not been seen before changes nothing: it is compared from the next frame on.
    references = (image if known is None else known for known, image in zip(state.references, images, strict=True))
    return [changed(*pictures) for pictures in zip(references, images, setup.masks, strict=True)]


def _part(setup: Setup, gaussians: Gaussians, changes: Sequence[np.ndarray] | None) -> ActiveSet:
    """Return what of the scene has to do with that."""
    if changes is None:
        return full_active_set(gaussians, setup.cameras, setup.config.render)
    maps = ("motion", "confidence")
    channels = [("color", *(maps if v in setup.key_views else ())) for v in range(len(setup.cameras))]
    return find_active_set(gaussians, setup.cameras, changes, channels, setup.config.render)


def _first_gaussians(setup: Setup, images: Sequence[np.ndarray], rng: np.random.Generator) -> tuple[Gaussians, str]:
    """Place the Gaussians of the first frame, and say so if there was nothing to place them on."""
    count, status = setup.config.fit.first_count, "ok"
    points, colors = setup.points, setup.point_colors
    if len(points) < MIN_POINTS:
        status = f"the capture has {len(points)} points, too few: seeded {count} random ones inside the views"
        _LOG.warning("frame 0: %s", status)
        points, colors = seed_points(setup.cameras, images, count, rng)
    points, colors = resample_points(points, colors, count, rng)
    return from_points(points, colors, setup.config.fit.sh_degree), status


def _first_confidence(
    setup: Setup, state: StreamState, cues: Mapping[int, FlowObservation], rng: np.random.Generator
) -> Gaussians:
    """Learn who moves from the first frame's masks, which the flow to the second frame alone can tell."""
    assert state.gaussians is not None
    method = setup.config.motion.mask_method
    masks = {v: motion_mask(state.images[v], cue.forward_flow, cue.forward_reliable, method) for v, cue in cues.items()}
    fitted, _ = fit_confidence(state.gaussians, setup.cameras, masks, setup.config.fit, setup.config.render, rng)
    return fitted


def _cues(
    setup: Setup, state: StreamState, images: Sequence[np.ndarray], changes: Sequence[np.ndarray] | None
) -> Mapping[int, FlowObservation]:
    """Compute flow on the key views where something has changed, if anything uses it, and masks at keyframes."""
    motion = setup.config.motion
    with_masks = motion.learn_confidence and state.frame % motion.mask_interval == 0
    first_masks = motion.learn_confidence and state.frame == 1
    if not (motion.learn_motion or with_masks or first_masks):
        return {}
    pairs = {}
    for v in setup.key_views:
        box = None if changes is None else around(changes[v])
        if changes is None or box is not None:
            pairs[v] = FramePair(images[v], state.images[v], setup.cameras[v].name, state.frame, setup.masks[v], box)
    return observe_key_views(pairs, motion, with_masks)


def _seen_only(setup: Setup, state: StreamState, views: Sequence[int]) -> tuple[Setup, StreamState]:
    """Return what `step` needs if there are pictures of `views` alone; flow takes those that had one before, too."""
    if len(views) == len(setup.cameras) and all(image is not None for image in state.images):
        return setup, state
    before = [state.images[v] for v in views] if state.images else []
    both = [i for i, image in enumerate(before) if image is not None]
    key_views = tuple(i for i in both if views[i] in setup.key_views)
    if len(key_views) < len(setup.key_views) and both:
        cameras = [setup.cameras[views[i]] for i in both]
        key_views = tuple(both[k] for k in choose_key_views(cameras, len(setup.key_views)))
    cameras, masks = (tuple(values[v] for v in views) for values in (setup.cameras, setup.masks))
    references = tuple(state.references[v] for v in views) if state.references else ()
    return (
        replace(setup, cameras=cameras, masks=masks, key_views=key_views),
        replace(state, images=tuple(before), references=references),
    )


def _hold(setup: Setup, state: StreamState) -> tuple[StreamState, Packet, FrameReport]:
    """Let everything stand still for a frame that nobody has seen."""
    start = time.perf_counter()
    assert state.coded is not None
    packet = residual_packet(state.coded, state.coded.gaussians, None, setup.cameras, setup.config.codec)
    decoded, seconds = decode(state.coded, packet), time.perf_counter() - start
    report = FrameReport(state.frame, seconds, len(encode_packet(packet)), {}, len(decoded), "no view has a picture")
    return StreamState(state.frame + 1, decoded, ()), packet, report


class StreamLoop:
    """The causal loop as an object: push frames, get packets.

    Nothing looks ahead: the packet of a frame is final when `push` returns.

    Args:
        cameras: the training views.
        points: SfM points [P, 3], world units; fewer than 100 are replaced by random ones inside the views.
        point_colors: [P, 3] in [0, 1].
        config: settings.
        masks: per view [H, W] bool of valid pixels, or None.

    Raises:
        ValueError: no cameras, or points that do not fit their colours.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        points: np.ndarray,
        point_colors: np.ndarray,
        config: StreamConfig | None = None,
        masks: Sequence[np.ndarray | None] | None = None,
    ) -> None:
        config = config or StreamConfig()
        if not cameras:
            raise ValueError("StreamLoop(): `cameras` must hold at least one view, got none.")
        points, point_colors = np.reshape(points, (-1, 3)), np.reshape(point_colors, (-1, 3))
        if points.shape != point_colors.shape:
            raise ValueError(
                f"StreamLoop(): `point_colors` must be {points.shape} like `points`, got {point_colors.shape}."
            )
        if not np.isfinite(points).all():
            raise ValueError(
                f"StreamLoop(): `points` must be finite, point {np.argwhere(~np.isfinite(points))[0][0]} is not; "
                "clean the model."
            )
        self.setup = Setup(
            tuple(cameras),
            tuple(masks) if masks is not None else (None,) * len(cameras),
            points,
            point_colors,
            choose_key_views(cameras, config.motion.key_views),
            scene_extent(cameras),
            config,
        )
        self.state = StreamState(0, None, ())

    @property
    def gaussians(self) -> Gaussians | None:
        """The decoded Gaussians of the last frame, None before the first."""
        return self.state.gaussians

    def resume(self, coded: CodedFrame, frames: Iterable[Sequence[np.ndarray | None]]) -> None:
        """Go on behind a frame that a stream holds, as if it had just been pushed.

        Args:
            coded: what the stream says of it.
            frames: the pictures of all frames up to it, as for `push`; the last ones do where nothing is left out.
        """
        images, references = (), ()
        for pictures in frames:
            images, references = tuple(pictures), self._renewed(references, pictures)
        self.state = StreamState(coded.frame + 1, coded, images, references)

    def _renewed(
        self, references: Sequence[np.ndarray | None], images: Sequence[np.ndarray | None]
    ) -> tuple[np.ndarray | None, ...]:
        """Return what the next frame's pictures are compared with."""
        if not self.setup.config.fit.skip_static:
            return ()
        views = zip(references or (None,) * len(images), images, self.setup.masks, strict=True)
        return tuple(renewed(*pictures) for pictures in views)

    def push(
        self, images: Sequence[np.ndarray | None], on_step: Callable[[int, int], None] | None = None
    ) -> tuple[Packet, FrameReport]:
        """Take in the next frame.

        Args:
            images: per training view uint8 [H, W, 3], RGB, or None: the view is left out of this frame.
            on_step: called with (steps done, steps of this frame).

        Returns:
            The packet for the stream, and the frame's report.

        Raises:
            ValueError: a picture has another size or type than its camera says, or the first frame has none at all.
        """
        _check_images(self.setup.cameras, images, self.state.frame)
        seen = {view: image for view, image in enumerate(images) if image is not None}
        if seen:
            setup, state = _seen_only(self.setup, self.state, tuple(seen))
            state, packet, report = step(setup, state, tuple(seen.values()), on_step)
        else:
            state, packet, report = _hold(self.setup, self.state)
        self.state = replace(state, images=tuple(images), references=self._renewed(self.state.references, images))
        left_out = tuple(camera.name for v, camera in enumerate(self.setup.cameras) if v not in seen)
        return packet, replace(report, left_out=left_out)


def _check_images(cameras: Sequence[Camera], images: Sequence[np.ndarray | None], frame: int) -> None:
    if len(images) != len(cameras):
        raise ValueError(
            f"push(): frame {frame} must have one picture for each of {len(cameras)} views, or None, got {len(images)}."
        )
    if not frame and all(image is None for image in images):
        raise ValueError("push(): frame 0 must have a picture of at least one view, got none; begin with one that has.")
    for camera, image in zip(cameras, images, strict=True):
        if image is not None and (image.shape != (camera.height, camera.width, 3) or image.dtype != np.uint8):
            raise ValueError(
                f"push(): frame {frame} of view {camera.name!r} must be uint8 [{camera.height}, {camera.width}, 3], "
                f"got {image.dtype} {list(image.shape)}."
            )

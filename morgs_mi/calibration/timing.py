"""Time offsets of the cameras of a rig whose clocks are apart, from what moves in their images.

At an instant, Gaussians are fitted to the images of all training views, and the flow of the views is lifted to their
displacement in one frame (see `method.lift`). A view whose clock is o frames ahead shows them displaced by o times as
much, so that its error e = image - render is linear in o, with the gradient g of the image and the rendered motion m
(eq. 6) in pixels:

    e + o g . m = 0 ,    o = - sum_x e (g . m) / sum_x (g . m)^2 ,

a least squares over the pixels and colours of a view, with the sums of several instants added. Then the images are
interpolated at the instants that the offsets give, and the Gaussians are fitted again: Gauss-Newton steps. The images
that Gaussians are fitted to draw them to all offsets at once, and a displacement beyond what is linear hardly shows in
e, so that a step is too short. By what factor follows from the last two rounds,

    kappa = - sum_v s_v (o'_v - o_v) / sum_v s_v^2 ,

with s the step between them: the secant method. Offsets that all cameras have in common change nothing; those of the
training views have a mean of zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.interpolation import image_between
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import check_number
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import reduced
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.initialise import fill_points, from_points, resample_points, scene_extent, seed_points
from morgs_mi.io.video import ImageOrError
from morgs_mi.losses.ssim import Target
from morgs_mi.method.flow import observe_key_views
from morgs_mi.method.flow_sources.registry import FramePair
from morgs_mi.method.lift import lift_flow
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.config import RenderConfig

__all__ = ["TimeOffsets", "TimingConfig", "estimate_time_offsets", "time_step", "time_sums"]

# Shares of the offsets that a round finds: of the first, and bounds for the others.
_FIRST_SHARE, _SHARES = 0.7, (0.2, 1.2)


@dataclass(frozen=True)
class TimingConfig:
    """Settings of the estimate."""

    width: int = 160
    """Width of the images in pixels, at least: a small image is fitted fast, and an offset displaces by few pixels."""
    frames: int = 12
    """Frames from the start of the recording that are used."""
    instants: int = 2
    """Instants that Gaussians are fitted at, spread over these frames."""
    num_gaussians: int = 3000
    """Gaussians of an instant."""
    steps: int = 300
    """Optimisation steps of an instant."""
    rounds: int = 8
    """Rounds at most."""
    tolerance: float = 0.02
    """Largest step in frames of the last round: an offset is found to about half of it."""
    largest: int = 3
    """Largest offset from the mean of the training views, frames."""

    def __post_init__(self) -> None:
        for name, low in (
            ("width", 32),
            ("frames", 4),
            ("instants", 1),
            ("num_gaussians", 1),
            ("rounds", 1),
            ("largest", 1),
        ):
            check_number("TimingConfig()", name, getattr(self, name), f"[{low}, inf)")


@dataclass(frozen=True)
class TimeOffsets:
    """Time offsets of the cameras.

    Attributes:
        offsets: by name, the frame of each camera's clip that is simultaneous with frame 0 of the reference's, as in
            `ReadConfig.offset`.
        reference: name of the held-out camera, or of the first one, whose offset is as it was.
        change: largest change in the last round, frames.
        converged: whether it is within the tolerance.
    """

    offsets: dict[str, float]
    reference: str
    change: float
    converged: bool


def estimate_time_offsets(
    capture: Capture, config: TimingConfig | None = None, progress: Callable[[int, int], None] | None = None
) -> TimeOffsets:
    """Return the time offsets of a capture's cameras; those that it was read with are included.

    No Gaussian is fitted to the held-out view, whose offset follows from its error alone.

    Args:
        capture: a capture, whose clips have one frame rate.
        config: settings.
        progress: called with (fits done, fits at most).

    Raises:
        ValueError: the recording has fewer than four frames, an image is missing, or nothing moves.
    """
    config = config or TimingConfig()
    clips = _Clips.of(capture, config.frames, config.width)
    largest = (clips.num_frames - 2) // 2
    if largest < 1:
        raise ValueError(
            f"{capture.path}: expected at least 4 frames to compare clocks, got {clips.num_frames}; record longer."
        )
    largest = min(config.largest, largest)
    instants = np.linspace(largest, clips.num_frames - 2 - largest, config.instants).round().astype(int)
    offsets, step, pull = np.zeros(len(clips.cameras)), np.zeros(len(clips.cameras)), None
    for round_index in range(config.rounds):
        sums = np.zeros((len(clips.cameras), 2))
        for k, instant in enumerate(instants):
            sums += _sums_at(clips, instant - offsets, config)
            if progress is not None:
                progress(round_index * len(instants) + k + 1, config.rounds * len(instants))
        found = time_step(sums)
        if found is None:
            raise ValueError(
                f"{capture.path}: expected motion in the first {clips.num_frames} frames, found none; record something "
                "that moves."
            )
        found -= found[clips.train].mean()
        factor, pull = _secant(step, found, pull), found
        step = found / factor
        before, offsets = offsets, np.clip(offsets + step, -largest, largest)
        step = offsets - before
        if np.abs(step).max() < config.tolerance:
            break
    return _relative(capture, offsets, float(np.abs(step).max()), config.tolerance)


def time_step(sums: np.ndarray) -> np.ndarray | None:
    """Return o [V] in frames from the sums of -e (g . m) and (g . m)^2 [V, 2] of each view; None: nothing moves.

    A view that shows hardly any motion, against the others, gets an o near 0.
    """
    most = sums[:, 1].max()
    return sums[:, 0] / (sums[:, 1] + 1e-3 * most) if most > 0 else None


@dataclass(frozen=True, eq=False)
class _Clips:
    """The first frames of a capture, reduced.

    Attributes:
        cameras: V views.
        masks: valid pixels of each [H, W], or None.
        images: per view and frame uint8 [H, W, 3].
        train: indices of the training views.
        points: [P, 3], world units.
        point_colors: [P, 3] in [0, 1].
    """

    cameras: tuple[Camera, ...]
    masks: tuple[np.ndarray | None, ...]
    images: tuple[tuple[np.ndarray, ...], ...]
    train: list[int]
    points: np.ndarray
    point_colors: np.ndarray

    @classmethod
    def of(cls, capture: Capture, count: int, width: int) -> _Clips:
        clips = [[_checked(image) for image in capture.images(v, 0, count)] for v in range(len(capture.cameras))]
        views = zip(capture.cameras, (clip[0] for clip in clips), capture.masks, strict=True)
        cameras, _, masks = zip(*(reduced(*view, width) for view in views), strict=True)
        images = tuple(tuple(_resized(i, c) for i in clip) for clip, c in zip(clips, cameras, strict=True))
        return cls(cameras, masks, images, list(capture.train_views), capture.points, capture.point_colors)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.images[0])

    def at(self, times: np.ndarray) -> list[np.ndarray]:
        """Return the image of each view at a time of its own [V], in frames."""
        times = np.clip(times, 0, self.num_frames - 1)
        first = np.minimum(np.floor(times).astype(int), self.num_frames - 2)
        views = zip(self.images, first, times - first, strict=True)
        return [clip[k + round(s)] if s in (0, 1) else image_between(clip[k], clip[k + 1], s) for clip, k, s in views]


def _checked(image: ImageOrError) -> np.ndarray:
    if isinstance(image, Exception):
        raise image
    return image


def _resized(image: np.ndarray, camera: Camera) -> np.ndarray:
    return np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA))


def _sums_at(clips: _Clips, times: np.ndarray, config: TimingConfig) -> np.ndarray:
    """Return the sums of `time_step` [V, 2] at an instant, which each view shows at a time of its own [V]."""
    images, after = clips.at(times), clips.at(times + 1)
    targets = [Target(image, mask) for image, mask in zip(images, clips.masks, strict=True)]
    gaussians = _fitted(clips, images, targets, config)
    pairs = {v: FramePair(after[v], images[v], valid=clips.masks[v]) for v in clips.train}
    views = [ActiveView(camera) for camera in clips.cameras]
    lifted = lift_flow(gaussians, {v: views[v] for v in clips.train}, observe_key_views(pairs))
    moving = replace(gaussians, motion=lifted.displacement)
    return np.array([time_sums(moving, view, target) for view, target in zip(views, targets, strict=True)])


def _fitted(clips: _Clips, images: Sequence[np.ndarray], targets: Sequence[Target], config: TimingConfig) -> Gaussians:
    """Return Gaussians that are fitted to the images of the training views at one instant."""
    rng, count = np.random.default_rng(0), config.num_gaussians
    cameras, masks = [clips.cameras[v] for v in clips.train], [clips.masks[v] for v in clips.train]
    own, shown = [images[v] for v in clips.train], [targets[v] for v in clips.train]
    if len(clips.points):
        points, colors = fill_points(clips.points, clips.point_colors, cameras, own, masks, count, rng)
    else:
        points, colors = seed_points(cameras, own, masks, count, rng)
    start = from_points(*resample_points(points, colors, count, rng), 0)
    fit = FitConfig(sh_degree=0, num_gaussians=count, first_frame_steps=config.steps, dropping=0.0)
    return fit_first_frame(start, cameras, shown, scene_extent(cameras), fit, RenderConfig(), rng).gaussians


def time_sums(gaussians: Gaussians, view: ActiveView, target: Target) -> tuple[float, float]:
    """Return the sums of -e (g . m) and of (g . m)^2 in a view, as `time_step` takes them.

    Args:
        gaussians: N Gaussians at an instant, with their `motion` in one frame.
        view: a view.
        target: its image, at about the same instant.
    """
    image = view.render(gaussians, ("color", "motion"))
    slopes = np.stack(
        [cv2.Sobel(target.image(), cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1))], axis=2
    )
    change = np.einsum("hwac,hwa->hwc", slopes, np.asarray(image.motion))
    return -float(np.sum(target.difference(image.color) * change)), float(np.sum(change**2))


def _secant(step: np.ndarray, found: np.ndarray, before: np.ndarray | None) -> float:
    """Return kappa (see the module), the share of an offset that a round finds, within its bounds."""
    if before is None or not step.any():
        return _FIRST_SHARE
    return float(np.clip(-np.sum(step * (found - before)) / np.sum(step**2), *_SHARES))


def _relative(capture: Capture, offsets: np.ndarray, change: float, tolerance: float) -> TimeOffsets:
    """Return the result with the offsets from the reference's, in addition to those of the capture."""
    reference = capture.test_view or 0
    known = capture.reading.offset
    apart = offsets - [camera.delay for camera in capture.cameras]
    own = {n: known.get(n, 0.0) - (o - apart[reference]) for n, o in zip(capture.names, apart, strict=True)}
    rounded = {name: round(float(offset), 3) + 0.0 for name, offset in own.items()}
    return TimeOffsets(rounded, capture.names[reference], change, change < tolerance)

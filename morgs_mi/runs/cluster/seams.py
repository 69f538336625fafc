"""Seams: where a segment of a recording begins, and the stream continues with other Gaussians.

All segments start from one common model, the first two frames of the recording. A segment is fitted from some frames
before its first one (*overlap*). The first of these is fitted like a later frame of the common model, several times
over, until Gaussians that have travelled far since then arrive; the others follow as usual. What has not changed
since the first frames stays as it is, to the bit, and every other Gaussian keeps the number that it has in the common
model.

The segment before has followed the recording for many frames, and ends elsewhere. In the overlap, the stream fades from
its Gaussians to the next segment's (*cross-fade*). Otherwise the difference would appear within one frame, as a
flicker. With the share s of the next segment, which grows from 0 to 1 with a slope of zero at both ends:

- A Gaussian that both have inherited from the common model, and have at nearly the same place, is interpolated.
- Any other is drawn beside the other segment's, with a part of its optical depth: its opacity o becomes
  1 - (1 - o)^s if it belongs to the next segment, and 1 - (1 - o)^(1 - s) otherwise. Two that coincide are then as
  opaque together as each alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from typing import Annotated, NamedTuple

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import CodedFrame, decode, frames_near, residual_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.progress import Report
from morgs_mi.core.ranges import AtLeast, check_ranges
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.evaluate.results import VariationScores
from morgs_mi.evaluate.temporal import StillVariation, recorded_change
from morgs_mi.loop.observation import Setup
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.playback.player import render, render_config, truth_for_camera
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.stream_loop import FrameReport, StreamState, step

__all__ = [
    "COMMON_FRAMES",
    "Moment",
    "Overlap",
    "SeamScores",
    "SegmentConfig",
    "cross_fade",
    "fit_seam_frame",
    "score_seam",
]

COMMON_FRAMES = 2
"""Frames of the common model: the second one determines the confidence."""

# Factor on the learning rates of the fits of the first frame: there is further to go than between two frames.
_RATES = 2.0
# Largest number of births in each of them, as a fraction of the Gaussians.
_BIRTHS = 0.1
# Factor on the epochs of the other frames: the fit is not yet as good as one that followed from the beginning.
_OVERLAP_EPOCHS = 2
# Distance, in largest scales of the Gaussian, up to which it is interpolated in the cross-fade.
_NEAR = 1.0
_AROUND = 8  # frames before and after a seam, with which it is compared
_MIN_ODDS = 1e-4  # of a faded opacity, o / (1 - o); less is invisible, and nothing has no logarithm
_ATTRIBUTES = ("means", "quats", "log_scales", "logit_opacities", "sh_coeffs")


@dataclass(frozen=True)
class SegmentConfig:
    """Segments of a fit, and the seams between them."""

    count: int = 1
    """Number of segments of about the same length, of two frames at least; with one, the stream equals
    `stream_capture`'s."""
    passes: Annotated[int, AtLeast(1)] = 24
    """Fits of the first frame of the overlap, one after the other, each with a round of density control."""
    epochs: Annotated[int, AtLeast(1)] = 4
    """Passes over all training views in each of them."""
    overlap: Annotated[int, AtLeast(0)] = 10
    """Last frames of a segment that the next one fits too, and in which the stream fades to it."""

    def __post_init__(self) -> None:
        check_ranges(self)

    def overlap_config(self, config: StreamConfig) -> StreamConfig:
        """Return the settings of the other frames of the overlap."""
        return replace(config, fit=replace(config.fit, epochs=_OVERLAP_EPOCHS * config.fit.epochs))

    def fit_config(self, config: StreamConfig, number: int) -> StreamConfig:
        """Return the settings of one of these fits."""
        rates = replace(config.fit.rates, **{n: _RATES * rate for n, rate in asdict(config.fit.rates).items()})
        density = replace(config.fit.density, births=_BIRTHS)
        fit = replace(config.fit, epochs=self.epochs, rates=rates, density=density, early_stopping_tolerance=0.0)
        return replace(config, fit=fit, seed=config.seed + number)


@dataclass(frozen=True)
class SeamScores:
    """Scores of a seam, means over the held-out view or all training views.

    Attributes:
        frame: the first one of the segment.
        psnr: of that frame, dB.
        psnr_before: of the frame before, dB.
        psnr_around: mean of the other frames around the seam, dB.
        mtv: mTV from the frame before to that frame.
        mtv_around: mean mTV of the other pairs of frames around the seam.
        mtv_recorded: mTV of the recording from the frame before to that frame.
    """

    frame: int
    psnr: float
    psnr_before: float
    psnr_around: float
    mtv: float
    mtv_around: float
    mtv_recorded: float

    def __str__(self) -> str:
        return (
            f"frame {self.frame}: PSNR {self.psnr_before:.2f} and {self.psnr:.2f} dB, {self.psnr_around:.2f} dB "
            f"around; mTV {self.mtv:.3f}, {self.mtv_around:.3f} around, {self.mtv_recorded:.3f} recorded"
        )


class Moment(NamedTuple):
    """A frame and its images, in the order of the views; None where a view has none."""

    frame: int
    images: Sequence[np.ndarray | None]


def fit_seam_frame(
    setup: Setup,
    common: StreamState,
    now: Moment,
    config: SegmentConfig,
    progress: Report | None = None,
) -> tuple[CodedFrame, FrameReport]:
    """Fit a frame far from the common model, and return its state and its report.

    Args:
        setup: what all frames share.
        common: the common model, after its last frame.
        now: the frame.
        config: settings.
        progress: called with (stage, steps done, steps) of each pass.
    """
    # Motion over many frames is no speed.
    setup = replace(setup, cameras=tuple(camera.without_delays() for camera in setup.cameras))
    coded = common.coded
    assert coded is not None
    history = common.seen
    seconds = 0.0
    for number in range(config.passes):
        repeated = replace(setup, config=config.fit_config(setup.config, number))
        state = replace(common, frame=now.frame, coded=replace(coded, frame=now.frame - 1), seen=history)
        state, _, report = step(repeated, state, now.images, progress)
        coded = state.coded
        assert coded is not None
        history = replace(common.seen, images=state.seen.images)  # changes are relative to the common model again
        seconds += report.seconds
    return coded, replace(report, seconds=seconds)


@dataclass(frozen=True, eq=False)
class Overlap:
    """Two segments in the frames that both have.

    Attributes:
        ending: states of the segment that ends, of each frame.
        beginning: states of the next segment, of the same frames.
        shared_ids: number of ids of the common model; below it, both segments have the same Gaussians.
    """

    ending: Sequence[CodedFrame]
    beginning: Sequence[CodedFrame]
    shared_ids: int

    @property
    def states(self) -> list[tuple[CodedFrame, CodedFrame]]:
        """Both states of each frame."""
        return list(zip(self.ending, self.beginning, strict=True))

    @property
    def common_ids(self) -> np.ndarray:
        """Ids of the common model's Gaussians that both segments have at nearly the same place in all frames."""
        return reduce(np.intersect1d, (self._near_ids(*states) for states in self.states))

    def _near_ids(self, a: CodedFrame, b: CodedFrame) -> np.ndarray:
        """Return these ids in one frame."""
        ids, here, there = np.intersect1d(a.ids, b.ids, return_indices=True)
        means = np.asarray(a.gaussians.means)[here], np.asarray(b.gaussians.means)[there]
        largest = np.asarray(a.gaussians.scales).max(axis=1)[here]
        near = np.linalg.norm(means[0] - means[1], axis=1) <= _NEAR * largest
        return ids[near & (ids < self.shared_ids)]


def cross_fade(
    before: CodedFrame, overlap: Overlap, cameras: Sequence[Camera], config: CodecConfig
) -> Iterator[tuple[Packet, CodedFrame]]:
    """Yield the packets of the frames of an overlap, with the states after them.

    Args:
        before: state of the stream before the overlap.
        overlap: both segments.
        cameras: as for `residual_packet`.
        config: tolerated errors; changes are as precise as births, because the state of the next segment is, and what
            stayed a step behind it would appear at the seam.
    """
    config = replace(config, quality=config.quality * config.birth_precision, birth_precision=1.0)
    common, keys = overlap.common_ids, before.ids.astype(np.int64)
    for number, (a, b) in enumerate(overlap.states, start=1):
        time = number / (len(overlap.ending) + 1)
        gaussians, drawn = _blended(a, b, common, time * time * (3 - 2 * time))
        source = np.full(len(drawn), len(keys))
        _, here, there = np.intersect1d(drawn, keys, return_indices=True)
        source[here] = there
        order = np.argsort(source, kind="stable")  # births come last
        source = np.where(source < len(keys), source, -1)
        packet = residual_packet(before, gaussians.select(order), source[order], cameras, config)
        before, keys = decode(before, packet), drawn[order]
        yield packet, before


def _blended(a: CodedFrame, b: CodedFrame, common: np.ndarray, share: float) -> tuple[Gaussians, np.ndarray]:
    """Return the Gaussians of two states with a share of the second, and a key of each.

    A key is an id of the first state, or -1 - id for a Gaussian that is in the second state only.
    """
    raw, goal = a.gaussians.numpy(), b.gaussians.numpy()
    here, there = np.isin(a.ids, common), np.isin(b.ids, common)
    for name in _ATTRIBUTES:
        start, end = raw[name][here], goal[name][there]
        if name == "quats":  # a quaternion and its negative are one rotation
            end = end * np.where((end * start).sum(axis=1, keepdims=True) < 0, -1, 1)
        raw[name][here] = start + np.float32(share) * (end - start)
    raw["logit_opacities"][~here] = _faded(raw["logit_opacities"][~here], 1 - share)
    goal["logit_opacities"][~there] = _faded(goal["logit_opacities"][~there], share)
    # A keyframe has neither motion nor offset.
    added = {n: goal[n][~there] if n in goal else np.zeros_like(v, shape=((~there).sum(), 3)) for n, v in raw.items()}
    gaussians = Gaussians(**{name: np.concatenate([value, added[name]]) for name, value in raw.items()})
    return gaussians, np.concatenate([a.ids.astype(np.int64), -1 - b.ids[~there].astype(np.int64)])


def _faded(logit_opacities: np.ndarray, share: float) -> np.ndarray:
    """Return the logits of opacities with a share of the optical depth -log(1 - o)."""
    depth = np.logaddexp(0, logit_opacities.astype(np.float64))
    return np.log(np.maximum(np.expm1(share * depth), _MIN_ODDS)).astype(np.float32)


def score_seam(stream: StreamReader, capture: Capture, frame: int) -> SeamScores:
    """Return the scores of the seam before a frame, of a stream and its recording.

    Pixels are static if they are so in all frames around the seam, eight on either side.
    """
    first, last = max(frame - _AROUND, 0), min(frame + _AROUND, capture.num_frames)
    views = capture.test_views or capture.train_views
    config = render_config(stream)
    rendered: dict[int, dict[int, np.ndarray]] = {}
    cameras = capture.with_delays(stream.cameras)
    for coded in frames_near(stream, first):
        if first <= coded.frame < last:
            images = {v: render(coded.gaussians, cameras[v], ("color",), config)["color"] for v in views}
            rendered[coded.frame] = {view: to_uint8(image) for view, image in images.items()}
        if coded.frame == last - 1:
            break
    frames = {f.index: f.images for f in capture.partial_frames(first, last)}
    recorded = {t: {v: i for v, i in enumerate(images) if i is not None} for t, images in frames.items()}
    views = [v for v in views if all(v in images for images in recorded.values())]
    quality = {t: _mean([psnr(rendered[t][v], recorded[t][v]) for v in views]) for t in recorded}
    moving = {v: _moving(capture, v, recorded) for v in views}
    pairs = {t: [_variation(rendered, recorded, t, v, moving[v]) for v in views] for t in range(first + 1, last)}
    mtv = {t: _mean([variation.render for variation in found]) for t, found in pairs.items()}
    return SeamScores(
        frame,
        quality[frame],
        quality[frame - 1],
        _mean([value for t, value in quality.items() if t not in (frame - 1, frame)]),
        mtv[frame],
        _mean([value for t, value in mtv.items() if t != frame]),
        _mean([variation.input for variation in pairs[frame]]),
    )


# Images by frame and view.
_Clip = Mapping[int, Mapping[int, np.ndarray]]


def _moving(capture: Capture, view: int, recorded: _Clip) -> np.ndarray:
    """Return the pixels [H, W] of a view that move in any of some frames."""
    camera, frames = capture.cameras[view], sorted(recorded)
    truths = [truth_for_camera(capture, camera, t) for t in frames]
    masks = [truth.mask for truth in truths if truth is not None]
    if len(masks) < len(frames):
        masks = [recorded_change(recorded[t - 1][view], recorded[t][view]) for t in frames[1:]]
    return np.any(masks, axis=0)


def _variation(rendered: _Clip, recorded: _Clip, frame: int, view: int, moving: np.ndarray) -> VariationScores:
    """Return the variation of the static pixels of a view from the frame before to a frame."""
    variation = StillVariation()
    for t in (frame - 1, frame):
        variation.add(rendered[t][view], recorded[t][view], moving)
    return variation.result()


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")

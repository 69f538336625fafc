"""Seams: where a segment of a recording begins, and the stream continues with other Gaussians.

All segments start from one common model, the first two frames of the recording. A frame shortly before the segment is
fitted like a later frame of that model, several times over, so that Gaussians that have travelled far since then
arrive. The frames up to the segment follow as usual (*warm-up*), and are discarded. What has not changed since the
first frames stays as it is, to the bit, and every other Gaussian keeps the number that it has in the common model.

The segment before ends elsewhere: it has followed the recording for many frames. In its last frames, each Gaussian that
is in both models at nearly the same place is moved towards its state in the next segment, by an equal share per frame
(*handover*). So the difference does not appear within one frame, as a flicker.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.config import CodecConfig
from morgs_mi.codec.container import Packet
from morgs_mi.codec.packets import CodedFrame, frames_near, residual_packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.evaluate.results import VariationScores
from morgs_mi.evaluate.temporal import StillVariation, recorded_change
from morgs_mi.observation import Images, Seen, Setup
from morgs_mi.playback.player import render, render_config, truth_for_camera
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.stream_loop import FrameReport, StreamState, step

__all__ = ["COMMON_FRAMES", "SeamConfig", "SeamScores", "approached", "changed_packet", "fit_seam_frame", "score_seam"]

COMMON_FRAMES = 2
"""Frames of the common model: the second one determines the confidence."""

_AROUND = 8  # frames before and after a seam, with which it is compared
_ATTRIBUTES = ("means", "quats", "log_scales", "logit_opacities", "sh_coeffs")


@dataclass(frozen=True)
class SeamConfig:
    """Settings of the seams between segments."""

    passes: int = 8
    """Fits of the frame before the warm-up, one after the other, each with a round of density control."""
    epochs: int = 8
    """Passes over all training views in each of them."""
    rates: float = 2.0
    """Factor on the learning rates: there is further to go than between two frames."""
    births: float = 0.05
    """Largest number of births in each of them, as a fraction of the Gaussians."""
    warm_up: int = 10
    """Frames before a segment that are fitted first and discarded: the model follows the motion and improves."""
    handover: int = 12
    """Last frames of a segment, in which it approaches the next one."""
    nearness: float = 0.3
    """Distance, in largest scales of the Gaussian, up to which it counts as the same in both segments."""

    def fit_config(self, config: StreamConfig, number: int) -> StreamConfig:
        """Return the settings of one of these fits."""
        rates = replace(config.fit.rates, **{n: self.rates * rate for n, rate in asdict(config.fit.rates).items()})
        density = replace(config.fit.density, births=self.births)
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


def fit_seam_frame(
    setup: Setup,
    base: CodedFrame,
    earlier: Images,
    frame: int,
    images: Images,
    config: SeamConfig,
    on_step: Callable[[int, int], None] | None = None,
) -> tuple[CodedFrame, FrameReport]:
    """Fit a frame far from the common model, and return its state and its report.

    Args:
        setup: what all frames share.
        base: the common model.
        earlier: images of its last frame, by view index.
        frame: index of the frame.
        images: its images, by view index.
        config: settings.
        on_step: called with (steps done, steps) of each pass.
    """
    coded, last, seconds = base, earlier, 0.0
    for number in range(config.passes):
        repeated = replace(setup, config=config.fit_config(setup.config, number))
        state = StreamState(frame, replace(coded, frame=frame - 1), Seen(last, earlier))
        state, _, report = step(repeated, state, [images.get(view) for view in range(len(setup.cameras))], on_step)
        assert state.coded is not None
        coded, last, seconds = state.coded, images, seconds + report.seconds
    return coded, replace(report, seconds=seconds)


def approached(now: CodedFrame, following: CodedFrame, shared_ids: int, share: float, config: SeamConfig) -> Gaussians:
    """Return the Gaussians of a frame a share of the way closer to those of the next segment.

    Args:
        now: state of the frame.
        following: state of the next segment's first frame.
        shared_ids: number of ids of the common model; below it, both states have the same Gaussians.
        share: share of the way, in (0, 1].
        config: settings.
    """
    raw, goal = now.gaussians.numpy(), following.gaussians.numpy()
    ids, here, there = np.intersect1d(now.ids, following.ids, return_indices=True)
    distance = np.linalg.norm(raw["means"][here] - goal["means"][there], axis=1)
    near = (distance <= config.nearness * np.exp(raw["log_scales"][here]).max(axis=1)) & (ids < shared_ids)
    here, there = here[near], there[near]
    values = {name: raw[name] for name in _ATTRIBUTES}
    for name, value in values.items():
        end = goal[name][there]
        if name == "quats":  # a quaternion and its negative are one rotation
            end = end * np.where((end * value[here]).sum(axis=1, keepdims=True) < 0, -1, 1)
        value[here] += share * (end - value[here])
    return replace(now.gaussians, **values)


def changed_packet(
    before: CodedFrame, now: CodedFrame, gaussians: Gaussians, cameras: Sequence[Camera], config: CodecConfig
) -> Packet:
    """Return the residual from the frame before to `gaussians`, which have the ids of the frame."""
    source = np.full(len(now), -1)
    _, earlier, later = np.intersect1d(before.ids, now.ids, return_indices=True)
    source[later] = earlier
    return residual_packet(before, gaussians, source, cameras, config)


def score_seam(stream: StreamReader, capture: Capture, frame: int) -> SeamScores:
    """Return the scores of the seam before a frame, of a stream and its recording.

    Pixels are static if they are so in all frames around the seam, eight on either side.
    """
    first, last = max(frame - _AROUND, 0), min(frame + _AROUND, capture.num_frames)
    views = capture.train_views if capture.test_view is None else (capture.test_view,)
    config = render_config(stream)
    rendered: dict[int, dict[int, np.ndarray]] = {}
    for coded in frames_near(stream, first):
        if first <= coded.frame < last:
            images = {v: render(coded.gaussians, stream.cameras[v], ("color",), config)["color"] for v in views}
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

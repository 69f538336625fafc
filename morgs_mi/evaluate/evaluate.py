"""Evaluate a stream: compare its decoded frames with the recording and with the ground truth.

Every score is one number per view and frame. Frames average over views and the clip over frames; NaN stands for an
unknown score. A name with ``_moving`` or ``_still`` is the score of a region: the pixels whose surface moved since the
last frame (in the first frame: until the next) according to ``truth/``, or the pixels in which the recording changed
by more than its noise if there is no truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from morgs_mi.calibration.refine import register_camera
from morgs_mi.capture.capture import Capture
from morgs_mi.codec.container import PacketKind, encode_packet
from morgs_mi.codec.packets import CodedFrame, coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.evaluate.metrics import WINDOW, endpoint_error, iou, mean_over, psnr_of, ssim_map, unit_pair
from morgs_mi.evaluate.motion3d import evaluate_motion
from morgs_mi.evaluate.perception import delta_e_map, flip_map
from morgs_mi.evaluate.results import (
    Evaluation,
    FrameScores,
    Motion3DScores,
    PlaybackTimes,
    Sizes,
    VariationScores,
    ViewScores,
    known_mean,
)
from morgs_mi.evaluate.temporal import StillVariation, recorded_change, slope
from morgs_mi.evaluate.tracking import evaluate_tracks
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.forecast import forecast
from morgs_mi.fit.initialise import scene_extent
from morgs_mi.fit.view import View, mean_psnr
from morgs_mi.io.bounded import read_json
from morgs_mi.method.exposure import follow_exposure
from morgs_mi.playback.player import (
    has_confidence,
    open_stream,
    open_stream_capture,
    playback_speed,
    render,
    render_config,
    truth_for_camera,
)
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.synth.ground_truth import GroundTruth, Tracks, load_tracks, load_truth

__all__ = ["IMAGE_SCORES", "REGIONS", "evaluate_stream"]

REGIONS = ("", "_moving", "_still")
IMAGE_SCORES = ("psnr", "ssim", "flip", "delta_e", "lpips")
# Compression flickers: after a hundred frames half the pixels of a real recording have changed once.
_FALSE_ALARMS = 0.02


@dataclass(frozen=True)
class _RecordedView:
    """One recorded view of one frame."""

    image: np.ndarray
    valid: np.ndarray | None  # None: all pixels are valid
    moving: np.ndarray | None  # None: unknown
    truth: GroundTruth | None


def evaluate_stream(
    out: str | Path,
    capture: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    lpips: Lpips | None = None,
) -> Evaluation:
    """Decode a stream and compare it with its recording: in the held-out view, or otherwise in all training views.

    Args:
        out: stream file or its folder; seconds, and the estimate of other views, come from the ``report.json`` beside
            it.
        capture: recording; default is the capture that the stream was fitted to.
        progress: called with (frames done, frames in all).
        lpips: network for LPIPS; without one there is no LPIPS.

    Returns:
        The scores of the clip, its frames and its views.

    Raises:
        FileNotFoundError: the stream or the capture is missing.
        ValueError: the stream is truncated, broken or empty, the stream was fitted to another capture, the
            network does not accept images of this size, or the true tracks are broken.
    """
    stream = open_stream(out)
    packets, count = _packets(stream)
    recording = open_stream_capture(stream, capture, list(packets))
    seconds, expected, expected_psnr = _of_fit(stream.path)
    views = recording.train_views if recording.test_view is None else (recording.test_view,)
    cameras = recording.with_delays(stream.cameras)
    channels = ("color", "motion", *(("confidence",) if has_confidence(stream) else ()))
    config, tracks = render_config(stream), _tracks(recording)
    false_alarms = _FALSE_ALARMS if recording.truth is None else 0
    variations = {view: StillVariation(recording.masks[view], false_alarms) for view in views}
    rows: list[FrameScores] = []
    before, last, registered = None, None, float("nan")
    # The file may have grown since it was read.
    decoded = coded_frames(islice(stream, count))
    recorded = recording.partial_frames(min(packets), max(packets) + 1)
    for coded, frame in zip(decoded, recorded, strict=True):
        kind, num_bytes = packets[coded.frame]
        scores: dict[str, ViewScores] = {}
        for view in views:
            camera, image = cameras[view], frame.images[view]
            if image is None:
                scores[camera.name] = ViewScores()
                continue
            maps = render(coded.gaussians, camera, channels, config)
            previous = None if last is None else last[view]
            seen = _recorded_view(recording, camera, coded.frame, image, previous, recording.masks[view])
            # A decoder shows 8 bits.
            rendered = to_uint8(maps["color"])
            moving = np.zeros(seen.image.shape[:2], bool) if seen.moving is None else seen.moving
            variations[view].add(rendered, seen.image, moving)
            truth = seen.truth if kind == PacketKind.RESIDUAL else None
            scores[camera.name] = _view_scores(rendered, maps, seen, truth, lpips)
        motion = _motion_3d(recording, tracks, before, coded) if kind == PacketKind.RESIDUAL else None
        mean = ViewScores.mean(list(scores.values()))
        rows.append(
            FrameScores(coded.frame, kind.name.lower(), num_bytes, seconds.get(coded.frame), mean, motion, scores)
        )
        if not rows[1:] and recording.test_view is not None:
            registered = _registered_psnr(stream, recording, coded, frame.images[views[0]])
        before, last = coded, frame.images
        if progress is not None:
            progress(len(rows), len(packets))
    return Evaluation(
        stream=str(stream.path.resolve()),
        capture=str(recording.path.resolve()),
        held_out=recording.test_view is not None,
        complete=len(rows) == stream.metadata.get("num_frames", len(rows)),
        regions="recorded change" if recording.truth is None else "true masks",
        sizes=_sizes(stream.path.stat().st_size, rows),
        variation=VariationScores.mean([variation.result() for variation in variations.values()]),
        playback=PlaybackTimes(**playback_speed(stream, stream.cameras[views[0]])),
        psnr_slope=slope([row.scores.psnr for row in rows]),
        frames=tuple(rows),
        tracking=evaluate_tracks(stream, recording, views),
        registered_psnr=registered,
        expected=expected or _forecast(recording),
        expected_psnr=expected_psnr,
    )


def _registered_psnr(stream: StreamReader, recording: Capture, coded: CodedFrame, image: np.ndarray | None) -> float:
    """Return the PSNR of the held-out view from the camera that fits its image best, NaN without the image."""
    test, config = recording.test_view, render_config(stream)
    if image is None or test is None:
        return float("nan")
    extent = scene_extent([stream.cameras[v] for v in recording.train_views])
    view = View(stream.cameras[test], image, recording.masks[test])
    registered = view._replace(camera=register_camera(coded.gaussians, view, extent, FitConfig(), config))
    return mean_psnr(coded.gaussians, [registered], config)


def _packets(stream: StreamReader) -> tuple[dict[int, tuple[PacketKind, int]], int]:
    """Return kind and size of each frame's packet, and the number of packets.

    They are read from the file and not from the fit's report, because a receiver has only the file.
    """
    packets, count = {}, 0
    for packet in stream:
        # Later packets of a frame are re-emitted keyframes.
        packets.setdefault(packet.frame, (packet.kind, len(encode_packet(packet))))
        count += 1
    if not packets:
        raise ValueError(f"{stream.path}: expected at least one frame, got a header alone; fit the capture again.")
    return packets, count


def _recorded_view(
    recording: Capture,
    camera: Camera,
    frame: int,
    image: np.ndarray,
    last: np.ndarray | None,
    valid: np.ndarray | None,
) -> _RecordedView:
    """Return an image with its moving region, from the ground truth or from the change since the last image."""
    truth = truth_for_camera(recording, camera, frame)
    if truth is not None:
        return _RecordedView(image, valid, truth.mask, truth)
    moving = None if last is None or recording.truth is not None else recorded_change(last, image)
    return _RecordedView(image, valid, moving, None)


def _view_scores(
    rendered: np.ndarray,
    maps: Mapping[str, np.ndarray],
    seen: _RecordedView,
    truth: GroundTruth | None,
    lpips: Lpips | None,
) -> ViewScores:
    """Return the scores of a rendered image, motion and confidence."""
    scores = replace(ViewScores(), **_image_scores(rendered, seen, lpips))
    return scores if truth is None else replace(scores, **_motion_scores(maps, truth))


def _image_scores(image: np.ndarray, seen: _RecordedView, lpips: Lpips | None) -> dict[str, float]:
    """Return the scores of a rendered image by metric and region."""
    whole = np.ones(image.shape[:2], bool) if seen.valid is None else seen.valid
    nothing = np.zeros_like(whole)
    moving = seen.moving
    regions = (whole, *((nothing, nothing) if moving is None else (whole & moving, whole & ~moving)))
    a, b = unit_pair("evaluate_stream", image, seen.image)
    maps = {"psnr": np.square(a - b), "flip": flip_map(a, b), "delta_e": delta_e_map(a, b)}
    if min(image.shape[:2]) >= WINDOW:
        maps["ssim"] = ssim_map(a, b)
    matched = follow_exposure(image, seen.image, seen.valid)(a).clip(0, 1)
    scores = {"psnr_matched": psnr_of(mean_over(np.square(matched - b), whole))}
    for name, values in maps.items():
        finish = psnr_of if name == "psnr" else float
        scores |= {name + r: finish(mean_over(values, mask)) for r, mask in zip(REGIONS, regions, strict=True)}
    if lpips is not None:
        distance = lpips.distance_map(image, seen.image)
        if distance.shape == whole.shape:
            scores |= {f"lpips{r}": mean_over(distance, mask) for r, mask in zip(REGIONS, regions, strict=True)}
        else:
            scores["lpips"] = mean_over(distance)
    return scores


def _motion_scores(maps: Mapping[str, np.ndarray], truth: GroundTruth) -> dict[str, float]:
    """Return the errors of the rendered motion and confidence."""
    motion, true, moving = maps["motion"], truth.motion, truth.mask
    scores = {
        "motion_error": endpoint_error(motion, true),
        "motion_error_moving": endpoint_error(motion, true, moving),
        "motion_error_still": endpoint_error(motion, true, ~moving),
        "true_motion_moving": endpoint_error(np.zeros_like(motion), true, moving),
    }
    if "confidence" in maps:
        scores["confidence_iou"] = iou(maps["confidence"][..., 0] > 0.5, moving)
    return scores


def _motion_3d(
    recording: Capture, tracks: Tracks | None, before: CodedFrame | None, now: CodedFrame
) -> Motion3DScores | None:
    """Return `evaluate_motion` of the Gaussians that exist in both frames, None without truth."""
    frame = now.frame
    if tracks is None or recording.truth is None or before is None or frame >= tracks.points.shape[1]:
        return None
    views = []
    for camera in recording.cameras:
        truth = load_truth(recording.truth, camera.name, frame - 1)
        views.append((camera.resized(*truth.mask.shape[::-1]), truth))
    _, then, later = np.intersect1d(before.ids, now.ids, return_indices=True)
    old = before.gaussians.numpy()["means"][then].astype(float)
    new = now.gaussians.numpy()["means"][later].astype(float)
    points = tracks.points[:, frame - 1], tracks.points[:, frame], tracks.ids
    return evaluate_motion(old, new - old, np.asarray(before.gaussians.opacities)[then], points, views)


def _tracks(recording: Capture) -> Tracks | None:
    if recording.truth is None or not (recording.truth / "tracks.npz").is_file():
        return None
    return load_tracks(recording.truth)


def _sizes(num_bytes: int, rows: list[FrameScores]) -> Sizes:
    """Return the sizes of a stream file of `num_bytes`."""

    def mean(kind: str) -> float:
        return known_mean([row.num_bytes for row in rows if row.kind == kind])

    overhead = num_bytes - sum(row.num_bytes for row in rows)
    return Sizes(num_bytes, overhead, num_bytes / len(rows), mean("keyframe"), mean("residual"))


def _of_fit(stream: Path) -> tuple[dict[int, float], str, float]:
    """Return seconds by frame, and the sentence and the PSNR that the fit expects of other views.

    They come from the report beside the stream. Without one they are empty and NaN.
    """
    path = stream.with_name("report.json")
    if not path.is_file():
        return {}, "", float("nan")
    report = read_json(path)
    try:
        seconds = {row["frame"]: float(row["seconds"]) for row in report["frames"]}
        found = next((row["validation"] for row in report["frames"] if "sentence" in row.get("validation", {})), {})
        psnr = found.get("expected_psnr")
        return seconds, str(found.get("sentence", "")), float("nan" if psnr is None else psnr)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: expected a fit's report, got a broken one ({error!r}); remove it.") from None


def _forecast(recording: Capture) -> str:
    """Return what the rig lets expect of views between the training cameras, empty with a single one."""
    cameras = [recording.cameras[v] for v in recording.train_views]
    return forecast(cameras, recording.points).sentence if len(cameras) > 1 else ""

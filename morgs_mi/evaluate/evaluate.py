"""Judge a stream: how far its frames, as a receiver of the file sees them, are from what was recorded and is true.

Every score is one number per view and frame; frames are averaged over views, the clip over frames, and NaN stands for
what is unknown. A name with ``_moving`` or ``_still`` is the score of a region: where the surface that a pixel sees
moved since the last frame (in the first: until the next) by ``truth/``, or where the recording changed by more than
its noise if there is no truth.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.container import PacketKind, encode_packet
from morgs_mi.codec.packets import CodedFrame, coded_frames
from morgs_mi.core.camera import Camera
from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.evaluate.metrics import WINDOW, endpoint_error, iou, mean_over, psnr_of, ssim_map, unit_pair
from morgs_mi.evaluate.motion3d import evaluate_motion
from morgs_mi.evaluate.perception import delta_e_map, flip_map
from morgs_mi.evaluate.temporal import StillVariation, recorded_change, slope
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

__all__ = ["IMAGE_SCORES", "MOTION_SCORES", "REGIONS", "SECONDS", "evaluate_stream"]

REGIONS = ("", "_moving", "_still")
IMAGE_SCORES = ("psnr", "ssim", "flip", "delta_e", "lpips")
MOTION_SCORES = ("motion_error", "motion_error_moving", "motion_error_still", "true_motion_moving", "confidence_iou")
_SCORES = (*(name + region for name in IMAGE_SCORES for region in REGIONS), *MOTION_SCORES)
_NAN = float("nan")
# Compression flickers: after a hundred frames half the pixels of a real recording have changed once.
_FALSE_ALARMS = 0.02
SECONDS = (
    "wall time of a frame from the pictures in memory to its packet: flow, masks, optimisation, residual and its "
    "decoding; without reading the recording and without writing the packet"
)


@dataclass(frozen=True)
class _Seen:
    """One view of one frame, as recorded; `valid` is None where every pixel is."""

    recorded: np.ndarray
    valid: np.ndarray | None
    moving: np.ndarray | None
    truth: GroundTruth | None


def evaluate_stream(
    out: str | Path,
    capture: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """Decode a stream and compare it with its recording: in the held-out view, or else in all training views.

    Args:
        out: the stream file or its folder; seconds come from the ``report.json`` beside it.
        capture: the recording; default is where it was when it was fitted.
        progress: called with (frames done, frames in all).
        lpips: the user's network; without one there is no LPIPS.

    Returns:
        What JSON can hold, apart from scores that are infinite or NaN. ``frames`` has a row per frame, ``views`` the
        mean scores per camera, ``complete`` tells whether all frames that were to be fitted are there, the other
        entries are the whole clip's: PSNR in dB and SSIM (mean, first and last frame), FLIP, dE2000 (``delta_e``)
        and LPIPS, each of the whole view and by region (``regions`` tells by what); the endpoint error of the
        rendered motion in pixels, and the mean true motion where it moved; ``confidence_iou`` of rendered
        confidence above 0.5 and the true mask; ``motion_3d`` (see `motion3d`); ``mtv`` (see `StillVariation`);
        ``psnr_slope`` in dB per frame; ``playback``, ``bytes`` and ``seconds``.

    Raises:
        FileNotFoundError: the stream or the capture is missing.
        ValueError: the stream is truncated, broken or empty, the capture is not the one it was fitted to, or the
            network does not take its pictures.
    """
    stream = open_stream(out)
    # Not from the report: what counts is what a receiver of the file gets.
    packets, read = {}, 0
    for packet in stream:
        packets.setdefault(packet.frame, (packet.kind, len(encode_packet(packet))))  # what follows only restates it
        read += 1
    if not packets:
        raise ValueError(f"{stream.path}: expected at least one frame, got a header alone; fit the capture again.")
    recording = open_stream_capture(stream, capture, list(packets))
    seconds = _seconds(stream.path)
    views = recording.train_views if recording.test_view is None else (recording.test_view,)
    channels = ("color", "motion", *(("confidence",) if has_confidence(stream) else ()))
    config, tracks = render_config(stream), _tracks(recording)
    false_alarms = _FALSE_ALARMS if recording.truth is None else 0
    variations = {view: StillVariation(recording.masks[view], false_alarms) for view in views}
    rows, before, last = [], None, None
    # The file may have grown meanwhile.
    decoded = coded_frames(islice(stream, read))
    recorded = recording.partial_frames(min(packets), max(packets) + 1)
    for coded, frame in zip(decoded, recorded, strict=True):
        index, gaussians, scores = coded.frame, coded.gaussians, {}
        kind, num_bytes = packets[index]
        for view in views:
            camera, picture_then = stream.cameras[view], frame.images[view]
            if picture_then is None:
                scores[camera.name] = dict.fromkeys(_SCORES, _NAN)
                continue
            images = render(gaussians, camera, channels, config)
            seen = _seen(recording, camera, index, picture_then, last and last[view], recording.masks[view])
            # A decoder shows 8 bits.
            picture = to_uint8(images["color"])
            variations[view].add(picture, seen.recorded, _or_nothing(seen))
            truth = seen.truth if kind == PacketKind.RESIDUAL else None
            scores[camera.name] = _picture_scores(picture, seen, lpips) | _motion_scores(images, truth)
        mean = {name: _mean([score[name] for score in scores.values()]) for name in _SCORES}
        about = {"frame": index, "kind": kind.name.lower(), "num_bytes": num_bytes, "seconds": seconds.get(index)}
        motion = _motion_3d(recording, tracks, before, coded) if kind == PacketKind.RESIDUAL else {}
        rows.append({**about, **mean, "motion_3d": motion, "views": scores})
        before, last = coded, frame.images
        if progress is not None:
            progress(len(rows), len(packets))
    return {
        "stream": str(stream.path.resolve()),
        "capture": str(recording.path.resolve()),
        "held_out": recording.test_view is not None,
        "num_frames": len(rows),
        "complete": len(rows) == stream.metadata.get("num_frames", len(rows)),
        "regions": "recorded change" if recording.truth is None else "true masks",
        **_summary(stream.path.stat().st_size, rows),
        "mtv": _means([variation.result() for variation in variations.values()]),
        "playback": playback_speed(stream, stream.cameras[views[0]]),
        "views": {
            name: {score: _mean([row["views"][name][score] for row in rows]) for score in _SCORES}
            for name in rows[0]["views"]
        },
        "frames": rows,
    }


def _seen(
    recording: Capture,
    camera: Camera,
    frame: int,
    recorded: np.ndarray,
    last: np.ndarray | None,
    valid: np.ndarray | None,
) -> _Seen:
    """Gather what is known about a view of a frame."""
    truth = truth_for_camera(recording, camera, frame)
    if truth is not None:
        return _Seen(recorded, valid, truth.mask, truth)
    moving = None if last is None or recording.truth is not None else recorded_change(last, recorded)
    return _Seen(recorded, valid, moving, None)


def _or_nothing(seen: _Seen) -> np.ndarray:
    return np.zeros(seen.recorded.shape[:2], bool) if seen.moving is None else seen.moving


def _picture_scores(picture: np.ndarray, seen: _Seen, lpips: Lpips | None) -> dict[str, float]:
    """Return the scores of a rendered picture by name and region."""
    whole = np.ones(picture.shape[:2], bool) if seen.valid is None else seen.valid
    nothing = np.zeros_like(whole)
    moving = seen.moving
    regions = (whole, *((nothing, nothing) if moving is None else (whole & moving, whole & ~moving)))
    a, b = unit_pair("_picture_scores", picture, seen.recorded)
    maps = {"psnr": np.square(a - b), "flip": flip_map(a, b), "delta_e": delta_e_map(a, b)}
    if min(picture.shape[:2]) >= WINDOW:
        maps["ssim"] = ssim_map(a, b)
    scores = dict.fromkeys([name + region for name in IMAGE_SCORES for region in REGIONS], _NAN)
    for name, values in maps.items():
        finish = psnr_of if name == "psnr" else float
        scores |= {name + r: finish(mean_over(values, mask)) for r, mask in zip(REGIONS, regions, strict=True)}
    if lpips is not None:
        distance = lpips.distance_map(picture, seen.recorded)
        if distance.shape == whole.shape:
            scores |= {f"lpips{r}": mean_over(distance, mask) for r, mask in zip(REGIONS, regions, strict=True)}
        else:
            scores["lpips"] = mean_over(distance)
    return scores


def _motion_scores(images: Mapping[str, np.ndarray], truth: GroundTruth | None) -> dict[str, float]:
    """Return how far rendered motion and confidence are from the truth."""
    if truth is None:
        return dict.fromkeys(MOTION_SCORES, _NAN)
    motion, true, moving = images["motion"], truth.motion, truth.mask
    errors = [endpoint_error(motion, true, where) for where in (None, moving, ~moving)]
    speed = endpoint_error(np.zeros_like(motion), true, moving)
    overlap = iou(images["confidence"][..., 0] > 0.5, moving) if "confidence" in images else _NAN
    return dict(zip(MOTION_SCORES, (*errors, speed, overlap), strict=True))


def _motion_3d(
    recording: Capture, tracks: Tracks | None, before: CodedFrame | None, now: CodedFrame
) -> dict[str, float]:
    """Return `evaluate_motion` of those who live in both frames, empty without truth."""
    frame = now.frame
    if tracks is None or recording.truth is None or before is None or frame >= tracks.points.shape[1]:
        return {}
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


def _summary(num_bytes: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the whole clip's figures."""

    def packets(kind: str) -> list[int]:
        return [row["num_bytes"] for row in rows if row["kind"] == kind]

    means = {name: _mean([row[name] for row in rows]) for name in _SCORES}
    ends = {name: {"mean": means[name], "first": rows[0][name], "last": rows[-1][name]} for name in ("psnr", "ssim")}
    later = [row["seconds"] for row in rows[1:] if row["seconds"] is not None]
    return {
        **means,
        **ends,
        "psnr_slope": slope([row["psnr"] for row in rows]),
        "motion_3d": _means([row["motion_3d"] for row in rows if row["motion_3d"]]),
        "seconds": {"first": rows[0]["seconds"], "per_later_frame": _mean(later), "definition": SECONDS},
        "bytes": {
            "file": num_bytes,
            "overhead": num_bytes - sum(row["num_bytes"] for row in rows),  # header, index, keyframes to start from
            "per_frame": num_bytes / len(rows),
            "per_keyframe": _mean(packets("keyframe")),
            "per_residual": _mean(packets("residual")),
        },
    }


def _seconds(stream: Path) -> dict[int, float]:
    """Return seconds by frame from the report beside the stream, empty without one."""
    path = stream.with_name("report.json")
    if not path.is_file():
        return {}
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        return {row["frame"]: float(row["seconds"]) for row in report["frames"]}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected a fit's report, got a broken one ({error!r}); remove it.") from None


def _means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: _mean([row[name] for row in rows]) for name in rows[0]} if rows else {}


def _mean(values: Sequence[float]) -> float:
    """Return the mean of what is known, NaN where nothing is."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else _NAN

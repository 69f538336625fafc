"""Play a stream file: its frames as images, and how far these are from what was recorded.

Frame t's Gaussians carry their displacement since frame t-1, so that the motion map rendered with them lies on
frame t's pixel grid and says where each pixel came from, as the ground truth does. Keyframes carry none.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.truth import Truth, load_truth
from morgs_mi.codec.container import PacketKind, StreamReader, encode_packet
from morgs_mi.codec.gaussians import play
from morgs_mi.evaluate.metrics import WINDOW, endpoint_error, psnr, ssim
from morgs_mi.evaluate.pictures import as_picture, confidence_picture, depth_picture, motion_picture
from morgs_mi.gaussians.gaussians import Gaussians
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize

__all__ = ["CHANNELS", "channel_picture", "evaluate_stream", "find_camera", "open_stream", "render_stream", "truth_on"]

CHANNELS = ("color", "motion", "confidence", "depth", "alpha")
_IMAGE_SCORES = ("psnr", "ssim")
_MOTION_SCORES = ("motion_error", "motion_error_moving", "motion_error_still", "true_motion_moving")


def open_stream(out: str | Path) -> StreamReader:
    """Open a stream file, or the ``stream.morgs`` of a folder that ``morgs-mi fit`` has made.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no stream, or its header is broken or missing.
    """
    path = Path(out)
    path = path / "stream.morgs" if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a stream, found none; check the path or fit a capture first.")
    return StreamReader(path)


def find_camera(stream: StreamReader, camera: int | str) -> Camera:
    """Return a camera of the stream's rig by name or index.

    Raises:
        ValueError: the rig has no such camera.
    """
    names = [view.name for view in stream.cameras]
    index = names.index(camera) if camera in names else camera
    if str(index).isdecimal() and int(index) < len(names):
        return stream.cameras[int(index)]
    raise ValueError(
        f"{stream.path}: the camera must be an index in 0..{len(names) - 1} or one of {', '.join(names)}, "
        f"got {camera!r}."
    )


def render_stream(
    stream: StreamReader, camera: Camera, channels: Sequence[str] | None = None
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Render every frame of a stream for one camera, with the cut-offs that it was fitted with.

    Args:
        stream: the file.
        camera: any view, not necessarily one of the rig.
        channels: out of `CHANNELS`; None for color, motion, depth and, where the stream has it, confidence.

    Yields:
        (frame, images): per channel a float32 array [H, W, 1 to 3], colour display-referred, motion in pixels,
        depth in world units.

    Raises:
        ValueError: an unknown channel, one that the stream does not hold, or a broken packet.
    """
    config = _render_config(stream)
    for frame, gaussians in play(stream):
        yield frame, _render(gaussians, camera, channels or _carried(gaussians), config)


def channel_picture(name: str, image: np.ndarray, motion_scale: float | None = None) -> np.ndarray:
    """Return a rendered channel as a picture, uint8 RGB [H, W, 3].

    Args:
        name: one of `CHANNELS`.
        image: [H, W, 1 to 3].
        motion_scale: speed of full saturation in pixels; by default 3 % of the width, so that the frames of a clip
            compare.
    """
    if name == "motion":
        return motion_picture(image, motion_scale or 0.03 * image.shape[1])
    return {"confidence": confidence_picture, "depth": depth_picture}.get(name, as_picture)(image)


def evaluate_stream(
    out: str | Path,
    capture: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Decode a stream and compare it with its recording: in the held-out view, or else in all training views.

    Args:
        out: the stream file or its folder; seconds come from the ``report.json`` beside it.
        capture: the recording; default is where it was when it was fitted.
        progress: called with (frames done, frames in all).

    Returns:
        What JSON can hold, apart from scores that are infinite or NaN. ``frames`` has a row per frame, ``views`` the
        mean scores per camera, ``complete`` tells whether all frames that were to be fitted are there, the other
        entries are the whole clip's: PSNR in dB, SSIM, endpoint error of the rendered
        motion in pixels against ``truth/`` over the whole image, where the surface moved and where it stood still,
        the mean true motion where it moved, bytes, seconds. What is unknown is NaN or None.

    Raises:
        FileNotFoundError: the stream or the capture is missing.
        ValueError: the stream is truncated, broken or empty, or the capture is not the one it was fitted to.
    """
    stream = open_stream(out)
    # Not from the report: what counts is what a receiver of the file gets.
    packets = [(packet.frame, packet.kind, len(encode_packet(packet))) for packet in stream]
    if not packets:
        raise ValueError(f"{stream.path}: expected at least one frame, got a header alone; fit the capture again.")
    recording, config, seconds = _recording(stream, capture, packets), _render_config(stream), _seconds(stream.path)
    views = recording.train_views if recording.test_view is None else (recording.test_view,)
    rows = []
    # The file may have grown meanwhile.
    decoded = play(islice(stream, len(packets)))
    recorded = recording.frames(packets[0][0], packets[-1][0] + 1)
    for (index, kind, num_bytes), (_, gaussians), frame in zip(packets, decoded, recorded, strict=True):
        scores = {}
        for view in views:
            camera = stream.cameras[view]
            images = _render(gaussians, camera, ("color", "motion"), config)
            truth = truth_on(recording, camera, index) if kind == PacketKind.RESIDUAL else None
            scores[camera.name] = _scores(images, frame.images[view], recording.masks[view], truth)
        mean = {name: _mean([score[name] for score in scores.values()]) for name in (*_IMAGE_SCORES, *_MOTION_SCORES)}
        about = {"frame": index, "kind": kind.name.lower(), "num_bytes": num_bytes, "seconds": seconds.get(index)}
        rows.append({**about, **mean, "views": scores})
        if progress is not None:
            progress(len(rows), len(packets))
    return {
        "stream": str(stream.path.resolve()),
        "capture": str(recording.path.resolve()),
        "held_out": recording.test_view is not None,
        "num_frames": len(rows),
        "complete": len(rows) == stream.metadata.get("num_frames", len(rows)),
        **_summary(stream.path.stat().st_size, rows),
        "views": {
            name: {score: _mean([row["views"][name][score] for row in rows]) for score in _IMAGE_SCORES}
            for name in rows[0]["views"]
        },
        "frames": rows,
    }


def truth_on(capture: Capture, camera: Camera, frame: int) -> Truth | None:
    """Return the ground truth of a frame on the pixel grid of `camera`, or None where the capture has none.

    The nearest sample counts, for a mean across an outline would be the motion of nothing. Motion is in pixels of
    `camera`.
    """
    if capture.truth is None or not (capture.truth / camera.name / f"{frame:04d}.exr").is_file():
        return None
    truth = load_truth(capture.truth, camera.name, frame)
    H, W = truth.mask.shape
    rows = ((np.arange(camera.height) + 0.5) * H / camera.height).astype(int)[:, None]
    columns = ((np.arange(camera.width) + 0.5) * W / camera.width).astype(int)
    motion = truth.motion[rows, columns] * np.float32([camera.width / W, camera.height / H])
    return Truth(motion, truth.depth[rows, columns], truth.ids[rows, columns], truth.mask[rows, columns])


def _carried(gaussians: Gaussians) -> tuple[str, ...]:
    return ("color", "motion", "depth", *(("confidence",) if gaussians.logit_confidence is not None else ()))


def _render(
    gaussians: Gaussians, camera: Camera, channels: Sequence[str], config: RenderConfig
) -> dict[str, np.ndarray]:
    image = rasterize(gaussians, camera, channels, config=config)
    return {name: np.array(getattr(image, name)) for name in channels}


def _render_config(stream: StreamReader) -> RenderConfig:
    return RenderConfig(**stream.metadata.get("config", {}).get("render", {}))


def _recording(stream: StreamReader, capture: str | Path | None, packets: Sequence[tuple[int, Any, int]]) -> Capture:
    """Open what the stream was fitted to, as it was opened then."""
    about = stream.metadata
    if capture is None and "capture" not in about:
        raise ValueError(f"{stream.path}: its header names no capture to compare with; give one (--capture).")
    frames, path = [frame for frame, *_ in packets], capture or about["capture"]
    recording = load_capture(path, about.get("downscale", 1), about.get("test_view", "auto"), frames[-1] + 1)
    expected, found = _sizes(stream.cameras), _sizes(recording.cameras)
    if found != expected:
        raise ValueError(
            f"{path}: expected the cameras that {stream.path} was fitted to, {expected}, got {found}; "
            "give that capture (--capture)."
        )
    if frames != list(range(frames[0], frames[-1] + 1)) or recording.num_frames <= frames[-1]:
        raise ValueError(
            f"{stream.path}: expected consecutive frames out of the {recording.num_frames} of {path}, got {frames}; "
            "give the capture that was fitted (--capture)."
        )
    return recording


def _sizes(cameras: Sequence[Camera]) -> dict[str, tuple[int, int]]:
    return {camera.name: (camera.width, camera.height) for camera in cameras}


def _scores(
    images: dict[str, np.ndarray], recorded: np.ndarray, mask: np.ndarray | None, truth: Truth | None
) -> dict[str, float]:
    # A decoder shows 8 bits.
    picture = as_picture(images["color"])
    small = min(picture.shape[:2]) < WINDOW
    scores = {"psnr": psnr(picture, recorded, mask), "ssim": float("nan") if small else ssim(picture, recorded, mask)}
    if truth is None:
        return scores | dict.fromkeys(_MOTION_SCORES, float("nan"))
    motion, moving = images["motion"], truth.mask
    errors = [endpoint_error(motion, truth.motion, where) for where in (None, moving, ~moving)]
    speed = endpoint_error(np.zeros_like(motion), truth.motion, moving)
    return scores | dict(zip(_MOTION_SCORES, (*errors, speed), strict=True))


def _summary(num_bytes: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the whole clip's figures."""

    def packets(kind: str) -> list[int]:
        return [row["num_bytes"] for row in rows if row["kind"] == kind]

    ends = {
        name: {"mean": _mean([row[name] for row in rows]), "first": rows[0][name], "last": rows[-1][name]}
        for name in _IMAGE_SCORES
    }
    later = [row["seconds"] for row in rows[1:] if row["seconds"] is not None]
    return {
        **ends,
        **{name: _mean([row[name] for row in rows]) for name in _MOTION_SCORES},
        "seconds": {"first": rows[0]["seconds"], "per_later_frame": _mean(later)},
        "bytes": {
            "file": num_bytes,
            "header": num_bytes - sum(row["num_bytes"] for row in rows),
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


def _mean(values: Sequence[float]) -> float:
    """Return the mean of what is known, NaN where nothing is."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")

"""Play a stream file: its frames as images, its recording and ground truth, and how fast it plays.

Frame t's Gaussians carry their displacement since frame t-1, so that the motion map rendered with them lies on
frame t's pixel grid and says where each pixel came from, as the ground truth does. Keyframes carry none.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.packets import play
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.playback.visualise import confidence_image, depth_image, motion_image, to_uint8
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize
from morgs_mi.synth.ground_truth import GroundTruth, load_truth

__all__ = [
    "CHANNELS",
    "OFFSET_SCALE",
    "channel_image",
    "find_camera",
    "has_confidence",
    "has_offset",
    "open_stream",
    "open_stream_capture",
    "playback",
    "render",
    "render_config",
    "render_stream",
    "truth_for_camera",
]

CHANNELS = ("color", "motion", "confidence", "offset", "depth", "alpha")
# Of the speed at which motion is fully saturated: the learned offset is the smaller part of it.
OFFSET_SCALE = 0.1
_TIMED = 30


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
        (frame, images): per channel a float32 array [H, W, 1 to 3], colour display-referred, motion and offset in
        pixels, depth in world units.

    Raises:
        ValueError: an unknown channel, one that the stream does not hold, or a broken packet.
    """
    config = render_config(stream)
    for frame, gaussians in play(stream):
        yield frame, render(gaussians, camera, channels or _carried(gaussians), config)


def has_confidence(stream: StreamReader) -> bool:
    """Tell whether a stream carries a confidence about which anything was learned."""
    learned = stream.metadata.get("config", {}).get("motion", {}).get("learn_confidence", True)
    return learned and any(gaussians.logit_confidence is not None for _, gaussians in islice(play(stream), 1))


def has_offset(stream: StreamReader) -> bool:
    """Tell whether a stream's residuals hold the learned offset, which none does unless it was asked to."""
    residuals = (packet for packet in stream if packet.kind == PacketKind.RESIDUAL)
    return any("offset" in packet.arrays for packet in islice(residuals, 1))


def channel_image(name: str, image: np.ndarray, motion_scale: float | None = None) -> np.ndarray:
    """Return a rendered channel as a picture, uint8 RGB [H, W, 3].

    Args:
        name: one of `CHANNELS`.
        image: [H, W, 1 to 3].
        motion_scale: speed of full saturation in pixels, of an offset a tenth of it; by default 3 % of the width, so
            that the frames of a clip compare.
    """
    if name in ("motion", "offset"):
        scale = motion_scale or 0.03 * image.shape[1]
        return motion_image(image, scale if name == "motion" else OFFSET_SCALE * scale)
    return {"confidence": confidence_image, "depth": depth_image}.get(name, to_uint8)(image)


def playback(stream: StreamReader, camera: Camera) -> dict[str, float]:
    """Time how fast a receiver could show a stream on this machine: decode a frame, render its colour, read it back.

    At most the first 30 frames count, without the first, which compiles kernels, unless it is the only one.

    Returns:
        ``fps``, frames per second at the size of `camera`, and the medians ``decode_ms`` and ``render_ms`` that it
        follows from; NaN without a frame.

    Raises:
        ValueError: a broken packet.
    """
    config, times = render_config(stream), []
    frames = islice(play(stream), _TIMED)
    while True:
        start = time.perf_counter()
        _, gaussians = next(frames, (0, None))
        if gaussians is None:
            break
        decoded = time.perf_counter()
        if not times:
            render(gaussians, camera, ("color",), config)
        begun = time.perf_counter()
        to_uint8(render(gaussians, camera, ("color",), config)["color"])
        times.append((decoded - start, time.perf_counter() - begun))
    decode, show = np.median(times[1:] or times or [(np.nan, np.nan)], axis=0)
    return {"fps": float(1 / (decode + show)), "decode_ms": float(1e3 * decode), "render_ms": float(1e3 * show)}


def truth_for_camera(capture: Capture, camera: Camera, frame: int) -> GroundTruth | None:
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
    return GroundTruth(motion, truth.depth[rows, columns], truth.ids[rows, columns], truth.mask[rows, columns])


def _carried(gaussians: Gaussians) -> tuple[str, ...]:
    return ("color", "motion", "depth", *(("confidence",) if gaussians.logit_confidence is not None else ()))


def render(
    gaussians: Gaussians, camera: Camera, channels: Sequence[str], config: RenderConfig
) -> dict[str, np.ndarray]:
    """Render channels into float32 arrays [H, W, 1 to 3] by name; the offset is zero where nothing is known of it."""
    maps = [name for name in channels if name != "offset"]
    images = vars(rasterize(gaussians, camera, maps, config=config)) if maps else {}
    if "offset" in channels:
        offset = np.zeros((len(gaussians), 3)) if gaussians.offset is None else gaussians.offset
        learned = rasterize(replace(gaussians, motion=offset), camera, ("motion",), config=config)
        images = {**images, "offset": learned.motion}
    return {name: np.array(images[name]) for name in channels}


def render_config(stream: StreamReader) -> RenderConfig:
    """Return the cut-offs that the stream was fitted with."""
    return RenderConfig(**stream.metadata.get("config", {}).get("render", {}))


def open_stream_capture(stream: StreamReader, capture: str | Path | None, frames: Sequence[int]) -> Capture:
    """Open what the stream was fitted to, as it was opened then.

    Args:
        stream: the file.
        capture: the recording; default is where it was when it was fitted.
        frames: indices of the stream's frames.

    Raises:
        FileNotFoundError: the capture is missing.
        ValueError: the header names none, or it is not the one that was fitted.
    """
    about = stream.metadata
    if capture is None and "capture" not in about:
        raise ValueError(f"{stream.path}: its header names no capture to compare with; give one (--capture).")
    path = capture or about["capture"]
    reading = ReadConfig(**about.get("reading", {}))
    recording = load_capture(path, about.get("downscale", 1), about.get("test_view", "auto"), frames[-1] + 1, reading)
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

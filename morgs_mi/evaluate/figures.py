"""Figures of a stream: one column over time; motion, confidence and offset beside the truth, with
legends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.truth import GroundTruth
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import exposed
from morgs_mi.playback.player import (
    OFFSET_SCALE,
    channel_image,
    has_confidence,
    has_offset,
    render_stream,
)
from morgs_mi.playback.stream_header import open_stream_capture, stream_exposure, truth_for_camera
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.visualise import (
    confidence_image,
    confidence_legend,
    contact_sheet,
    label,
    motion_image,
    motion_legend,
    side_by_side,
    time_slice,
    to_uint8,
    write_png,
)

_ROWS = 4
_MARK = (255, 0, 0)


def draw_stream(
    out: str | Path,
    folder: str | Path,
    capture: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    any_recording: bool = False,
) -> list[Path]:
    """Draw a stream's held-out view, or without one its first training view, into PNG files.

    ``slice.png`` shows one column over time, recorded and rendered: the column in which the
    recording changes most. ``motion.png`` shows up to four frames beside the truth, with a legend.
    So do ``confidence.png``, if confidence was learned, and ``offset.png``, if the stream holds
    offsets; the latter stands beside the whole motion.

    Args:
        out: stream file or its folder.
        folder: output folder; created if missing.
        capture: recording; default is the capture that the stream was fitted to.
        progress: called with (frames done, frames in all).
        any_recording: as for `evaluate_stream`.

    Returns:
        Paths of the files.

    Raises:
        FileNotFoundError: the stream or the capture is missing.
        OSError: a file cannot be written.
        ValueError: as `open_stream_capture`, or the stream is broken or has no frame.
    """
    stream = open_stream(out)
    frames = stream.frame_numbers()
    recording = open_stream_capture(stream, capture, frames, any_recording).displayed()
    stops = stream_exposure(stream)
    view = recording.reference_view
    camera = recording.with_delays(stream.cameras)[view]
    scale = motion_scale(recording, camera)
    column, still = _busiest_column(recording, view, frames)
    renders = []
    recorded = []
    rows: dict[str, list[list[np.ndarray]]] = {"motion": []}
    row_frames = _row_frames(frames)
    channels = ["color", "motion"]
    if has_confidence(stream):
        channels.append("confidence")
    if has_offset(stream):
        channels.append("offset")
    playback = render_stream(stream, camera, channels)
    recorded_frames = recording.partial_frames(frames[0], frames[-1] + 1)
    for (index, images), frame in zip(playback, recorded_frames, strict=False):
        # Copies: views would keep all images of a long clip in memory.
        renders.append(to_uint8(exposed(images["color"], stops))[:, column].copy())
        pixels = frame.images[view]
        recorded.append(np.zeros_like(renders[-1]) if pixels is None else pixels[:, column].copy())
        if index in row_frames:
            truth = truth_for_camera(recording, camera, index)
            for name, row in _rows(index, images, truth, scale).items():
                rows.setdefault(name, []).append(row)
        if progress is not None:
            progress(len(renders), len(frames))
    sheets = {"slice": _slices(still, column, recorded, renders)}
    for name, (first_row, *later_rows) in rows.items():
        sheets[name] = contact_sheet([[*first_row, _legend(name, scale)], *later_rows])
    paths: list[Path] = []
    for name, sheet in sheets.items():
        paths.append(Path(folder) / f"{name}.png")
        write_png(paths[-1], sheet)
    return paths


def _row_frames(frames: Sequence[int]) -> set[int]:
    """Return the frames that are drawn as rows."""
    # Nothing moves up to the first frame.
    later_frames = frames[1:] or frames
    last = len(later_frames) - 1
    return {later_frames[i] for i in np.linspace(0, last, min(_ROWS, last + 1)).astype(int)}


def _rows(
    frame: int, images: Mapping[str, np.ndarray], truth: GroundTruth | None, scale: float
) -> dict[str, list[np.ndarray]]:
    """Return the rows of a frame in the sheets of motion, confidence and offset."""
    true_motion, mask = (None, None) if truth is None else (truth.motion, truth.mask)
    maps = {"true motion": true_motion, "motion": images["motion"]}
    rows = {"motion": _row(frame, partial(motion_image, scale_px=scale), maps)}
    if "confidence" in images:
        maps = {"true mask": mask, "confidence": images["confidence"]}
        rows["confidence"] = _row(frame, confidence_image, maps)
    if "offset" in images:
        whole = channel_image("motion", images["motion"], scale)
        offset = channel_image("offset", images["offset"], scale)
        rows["offset"] = _row(frame, to_uint8, {"motion": whole, "its offset": offset})
    return rows


def _legend(sheet: str, scale: float) -> np.ndarray:
    if sheet == "confidence":
        return confidence_legend()
    if sheet == "offset":
        return side_by_side([motion_legend(scale), motion_legend(OFFSET_SCALE * scale)])
    return motion_legend(scale)


def motion_scale(capture: Capture, camera: Camera) -> float:
    """Return the 95th percentile of the true speed of moving pixels, px; without truth 3 % of the
    camera's width.
    """
    truths = [truth_for_camera(capture, camera, frame) for frame in range(capture.num_frames)]
    motions = [truth.motion[truth.mask] for truth in truths[1:] if truth is not None]
    speeds = [np.linalg.norm(motion, axis=-1) for motion in motions]
    moving = np.concatenate(speeds) if speeds else np.zeros(0)
    return float(np.percentile(moving, 95)) if moving.size else 0.03 * camera.width


def _busiest_column(recording: Capture, view: int, frames: Sequence[int]) -> tuple[int, np.ndarray]:
    """Return the column of a view in which the recording changes most, and its last image."""
    change = np.zeros(recording.cameras[view].width)
    last = None
    for frame in recording.partial_frames(frames[0], frames[-1] + 1):
        pixels = frame.images[view]
        if pixels is None:
            continue
        image = pixels.astype(float)
        if last is not None:
            change += np.abs(image - last).sum((0, 2))
        last = image
    assert last is not None
    return int(change.argmax()), last.astype(np.uint8)


def _slices(
    still: np.ndarray, column: int, recorded: Sequence[np.ndarray], renders: Sequence[np.ndarray]
) -> np.ndarray:
    """Return an image with the column marked, beside the recorded and the rendered column over
    time.
    """
    picture = still.copy()
    picture[:, column] = _MARK
    over_time = [(recorded, "recorded, over time"), (renders, "rendered, over time")]
    slices = [label(time_slice(columns), title) for columns, title in over_time]
    return side_by_side([label(picture, f"column {column}"), *slices])


def _row(
    frame: int, draw: Callable[[np.ndarray], np.ndarray], maps: Mapping[str, np.ndarray | None]
) -> list[np.ndarray]:
    """Draw each map that is not None, labelled with its name."""
    return [
        label(draw(values), f"{name}, frame {frame}")
        for name, values in maps.items()
        if values is not None
    ]

"""What a judged stream looks like: one column over time, motion, confidence and offset, with truth and legends."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.core.camera import Camera
from morgs_mi.playback.player import (
    OFFSET_SCALE,
    channel_image,
    has_confidence,
    has_offset,
    open_stream,
    open_stream_capture,
    render_stream,
    truth_for_camera,
)
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

__all__ = ["draw_stream", "motion_scale"]

_ROWS = 4
_MARK = (255, 0, 0)


def draw_stream(
    out: str | Path,
    folder: str | Path,
    capture: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Draw a stream's held-out view, or else its first training view, into PNG files.

    ``slice.png`` has one column over time, recorded and rendered: the column in which the recording changes most.
    ``motion.png`` and, where one was learned, ``confidence.png`` have up to four frames beside the truth, and
    their legend; so has ``offset.png``, where the stream holds offsets, beside the motion that they are a part of.

    Args:
        out: the stream file or its folder.
        folder: where to write; made if missing.
        capture: the recording; default is where it was when it was fitted.
        progress: called with (frames done, frames in all).

    Returns:
        The files.

    Raises:
        FileNotFoundError: the stream or the capture is missing.
        OSError: a file cannot be written.
        ValueError: as `open_stream_capture`; or the stream is broken or has no frame.
    """
    stream = open_stream(out)
    frames = [packet.frame for packet in stream]
    if not frames:
        raise ValueError(f"{stream.path}: expected at least one frame, got a header alone; fit the capture again.")
    recording = open_stream_capture(stream, capture, frames)
    view = recording.train_views[0] if recording.test_view is None else recording.test_view
    camera = stream.cameras[view]
    # Nothing moves up to the first frame.
    later = frames[1:] or frames
    chosen = {later[i] for i in np.linspace(0, len(later) - 1, min(_ROWS, len(later))).astype(int)}
    scale = motion_scale(recording, camera)
    column, sight = _busiest_column(recording, view, frames)
    shown, recorded, motions, confidences, offsets = [], [], [], [], []
    trusted, corrected = has_confidence(stream), has_offset(stream)
    maps = (*(("confidence",) if trusted else ()), *(("offset",) if corrected else ()))
    played = render_stream(stream, camera, ("color", "motion", *maps))
    for (index, images), frame in zip(played, recording.partial_frames(frames[0], frames[-1] + 1), strict=False):
        # Copies, for the pictures of a long clip do not all fit in memory.
        shown.append(to_uint8(images["color"])[:, column].copy())
        seen = frame.images[view]
        recorded.append(np.zeros_like(shown[-1]) if seen is None else seen[:, column].copy())
        if index in chosen:
            truth = truth_for_camera(recording, camera, index)
            true_motion, mask = (None, None) if truth is None else (truth.motion, truth.mask)
            moved = {"true motion": true_motion, "motion": images["motion"]}
            motions.append(_row(index, partial(motion_image, scale_px=scale), moved))
            if trusted:
                found = {"true mask": mask, "confidence": images["confidence"]}
                confidences.append(_row(index, confidence_image, found))
            if corrected:
                whole = channel_image("motion", images["motion"], scale)
                part = channel_image("offset", images["offset"], scale)
                offsets.append(_row(index, to_uint8, {"motion": whole, "its offset": part}))
        if progress is not None:
            progress(len(shown), len(frames))
    sheets = {"slice": _slices(sight, column, recorded, shown), "motion": _with_legend(motions, motion_legend(scale))}
    if confidences:
        sheets["confidence"] = _with_legend(confidences, confidence_legend())
    if offsets:
        legends = [motion_legend(scale), motion_legend(OFFSET_SCALE * scale)]
        sheets["offset"] = _with_legend(offsets, side_by_side(legends))
    paths = [Path(folder) / f"{name}.png" for name in sheets]
    for path, sheet in zip(paths, sheets.values(), strict=True):
        write_png(path, sheet)
    return paths


def motion_scale(capture: Capture, camera: Camera) -> float:
    """Return a speed in pixels that few of the camera's pixels exceed; without truth 3 % of its width."""
    truths = [truth_for_camera(capture, camera, frame) for frame in range(capture.num_frames)]
    speeds = [np.linalg.norm(truth.motion[truth.mask], axis=-1) for truth in truths[1:] if truth is not None]
    moving = np.concatenate(speeds) if speeds else np.zeros(0)
    return float(np.percentile(moving, 95)) if moving.size else 0.03 * camera.width


def _busiest_column(recording: Capture, view: int, frames: Sequence[int]) -> tuple[int, np.ndarray]:
    """Return the column of a view in which the recording changes most, and the last picture of it."""
    change, last = np.zeros(recording.cameras[view].width), None
    for frame in recording.partial_frames(frames[0], frames[-1] + 1):
        if (seen := frame.images[view]) is None:
            continue
        picture = seen.astype(float)
        if last is not None:
            change += np.abs(picture - last).sum((0, 2))
        last = picture
    assert last is not None
    return int(change.argmax()), last.astype(np.uint8)


def _slices(sight: np.ndarray, column: int, recorded: Sequence[np.ndarray], shown: Sequence[np.ndarray]) -> np.ndarray:
    """Return where the column is in a picture, and what is recorded and rendered there over time."""
    marked = sight.copy()
    marked[:, column] = _MARK
    over_time = [(recorded, "recorded, over time"), (shown, "rendered, over time")]
    slices = [label(time_slice(columns), title) for columns, title in over_time]
    return side_by_side([label(marked, f"column {column}"), *slices])


def _row(
    frame: int, draw: Callable[[np.ndarray], np.ndarray], maps: Mapping[str, np.ndarray | None]
) -> list[np.ndarray]:
    """Draw those of the maps that are known, under their names."""
    return [label(draw(values), f"{name}, frame {frame}") for name, values in maps.items() if values is not None]


def _with_legend(rows: list[list[np.ndarray]], legend: np.ndarray) -> np.ndarray:
    return contact_sheet([[*rows[0], legend], *rows[1:]])

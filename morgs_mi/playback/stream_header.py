"""Content of a stream's header: name, cameras, settings, and the fitted capture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from reprlib import repr as shortened
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le

from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.fingerprint import fingerprint
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.capture.truth import GroundTruth, load_truth
from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.core.camera import Camera
from morgs_mi.platform.bounded import JsonObject, read_json
from morgs_mi.platform.checks import LARGEST, require, view_index
from morgs_mi.platform.config import Config, apply_values, check_value, types_of
from morgs_mi.platform.files import CAPTURE, REPORT, STREAM
from morgs_mi.playback.default_rig import BOX
from morgs_mi.render.render_config import RenderConfig

_Coordinate = Annotated[float, Ge(-LARGEST), Le(LARGEST)]
_Point = tuple[_Coordinate, _Coordinate, _Coordinate]
_REMEDY = "fit the capture again"
# Entries of the metadata that are read, with dots between the names of nested objects: their types,
# and the values of missing ones. A stream may come from anybody, and its metadata be any object.
_SCHEMA: dict[str, tuple[Any, Any]] = {
    "num_frames": (int, 0),
    "fingerprint": (str | None, None),  # imported streams have none
    "origin": (_Point, (0.0, 0.0, 0.0)),
    BOX: (tuple[_Point, _Point] | None, None),  # recordings have none
    "distortions": (dict[str, tuple[_Coordinate, _Coordinate]], {}),
    "downscale": (float, 1),
    "test_view": (tuple[int | str, ...] | int | str | None, "auto"),
    "reading": (dict, {}),
    "transfer.display_exposure": (Annotated[float, Ge(-100), Le(100)], 0.0),
    "config.render": (dict, {}),
    "config.fit.refine_cameras": (str, "off"),
    "config.motion.learn_confidence": (bool, True),
}


def stream_name(stream: FrameSource) -> str:
    """Return the name of a stream: the name of its folder or file, without `.morgs`.

    Bytes of the name that are not UTF-8 are replaced, because pages and messages to a browser
    cannot contain them.
    """
    path = Path(os.path.realpath(stream.path))  # unlike Path.resolve, also of a link to itself
    name = path.parent.name if path.name == STREAM else path.stem
    return os.fsencode(name).decode(errors="replace")


def find_camera(stream: FrameSource, camera: int | str) -> Camera:
    """Return a camera of the stream's rig by name or index.

    Raises:
        ValueError: the rig has no such camera.
    """
    names = [view.name for view in stream.cameras]
    return stream.cameras[view_index(stream.path, "the camera", camera, names)]


def truth_for_camera(capture: Capture, camera: Camera, frame: int) -> GroundTruth | None:
    """Return the ground truth of a frame on the pixel grid of `camera`, or None if the capture has
    none.

    It is resampled by the nearest neighbour: averages across an outline would be motions of no
    surface. Motion is in pixels of `camera`.
    """
    if capture.truth is None or not (capture.truth / camera.name / f"{frame:04d}.exr").is_file():
        return None
    truth = load_truth(capture.truth, camera.name, frame)
    H, W = truth.mask.shape
    at = np.ix_(_nearest_pixels(camera.height, H), _nearest_pixels(camera.width, W))
    motion = truth.motion[at] * np.array([camera.width / W, camera.height / H], np.float32)
    return GroundTruth(motion, truth.depth[at], truth.ids[at], truth.mask[at])


def _nearest_pixels(count: int, length: int) -> np.ndarray:
    """Return the indices [count] of the nearest of `length` pixels."""
    return ((np.arange(count) + 0.5) * length / count).astype(int)


def metadata_entry(stream: FrameSource, key: str) -> Any:
    """Return an entry of a stream's metadata, with tuples for lists.

    Args:
        stream: the file.
        key: of the schema.

    Raises:
        ValueError: it has another type, or lies outside of its range.
    """
    kind, value = _SCHEMA[key]
    entries: Any = stream.metadata
    *tables, name = key.split(".")
    for table in tables:
        entries = entries.get(table, {})
        check_value(_place(stream), key, entries, dict, _REMEDY)
    if name in entries:
        value = _tuples(entries[name])
        check_value(_place(stream), key, value, kind, _REMEDY)
    return value


def _tuples(value: Any) -> Any:
    """Return a JSON value with tuples for lists."""
    if isinstance(value, dict):
        return {name: _tuples(item) for name, item in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _place(stream: FrameSource) -> str:
    return f"{stream.path}: packet 0: metadata"


def render_config(stream: FrameSource) -> RenderConfig:
    """Return the renderer settings of the fit.

    Raises:
        ValueError: the stream's header has settings of other types or ranges.
    """
    return _stored_config(stream, "config.render", RenderConfig())


def _stored_config(stream: FrameSource, key: str, default: Config) -> Config:
    """Return the settings of a header under a key; older streams have some that went."""
    values = metadata_entry(stream, key)
    settings = {name: values[name] for name in types_of(type(default)).keys() & values}
    return apply_values(default, settings, f"{_place(stream)}: `{key}`")


def stream_exposure(stream: FrameSource) -> float:
    """Return the stops by which a display brightens a stream, 0 for the stream of a recording of 8
    bits.

    Raises:
        ValueError: the header has another value than a number from -100 to 100.
    """
    return float(metadata_entry(stream, "transfer.display_exposure"))


def num_frames(stream: FrameSource) -> int:
    """Return the number of frames of the capture that was fitted, zero if the stream's header does
    not state it.

    Raises:
        ValueError: the header states something else.
    """
    return metadata_entry(stream, "num_frames")


def stream_origin(stream: FrameSource) -> np.ndarray:
    """Return the point [3] of the capture's world to which a stream is relative, float64.

    Raises:
        ValueError: the stream's header states something else.
    """
    return np.array(metadata_entry(stream, "origin"), np.float64)


def stream_box(stream: FrameSource) -> np.ndarray | None:
    """Return the `scene_box` [2, 3] that the cameras of a stream without a recording see; None of
    a recording.

    Raises:
        ValueError: the stream's header states something else.
    """
    box = metadata_entry(stream, BOX)
    return None if box is None else np.array(box, np.float64)


def open_stream_capture(
    stream: FrameSource,
    capture: str | Path | None,
    frames: Sequence[int],
    any_recording: bool = False,
) -> Capture:
    """Open the capture to which a stream was fitted, with the settings of the fit.

    Args:
        stream: the file.
        capture: folder of the capture; default: the fit's, which the ``capture.json`` beside the
            stream names.
        frames: indices of the stream's frames.
        any_recording: whether the capture may be another recording by the same cameras.

    Raises:
        FileNotFoundError: the capture is missing.
        ValueError: no capture is named, the header's metadata do not state how it was read, the
            capture is not the one that was fitted, or there are no frames.
    """
    path = capture or fitted_capture(stream)
    reading = _stored_config(stream, "reading", ReadConfig())
    downscale = metadata_entry(stream, "downscale")
    test_view = metadata_entry(stream, "test_view")
    mark = metadata_entry(stream, "fingerprint")
    refines = metadata_entry(stream, "config.fit.refine_cameras") != "off"
    stop = max(frames, default=0) + 1
    recording = load_capture(
        path, downscale, "auto" if test_view == "auto" else None, stop, reading
    )
    sizes, recorded_sizes = (
        {camera.name: camera.size for camera in cameras}
        for cameras in (stream.cameras, recording.cameras)
    )
    expected = f"expected the recording that {stream.path} was fitted to"
    remedy = "pass that capture (--capture), or compare with any recording (--any-recording)"
    cameras = f"the cameras {recorded_sizes}, not {sizes}"
    require(recorded_sizes == sizes, path, expected, cameras, remedy)
    span = list(range(min(frames, default=0), min(stop, recording.num_frames)))
    number = f"{recording.num_frames} frames, not all of {shortened(frames)}"
    require(frames and frames == span, path, expected, number, remedy)
    if mark is not None and not any_recording:
        images = next(recording.partial_frames(0, 1)).images
        same = fingerprint(recording, images, refines) == mark
        others = "other images in its first frame, or other points"
        require(same, path, expected, others, remedy)
    if test_view != "auto":
        recording = recording.holding_out(test_view)
    # Other refined cameras change no image, and ground truth refers to the recording's cameras.
    if recording.display_exposure is not None:
        recording = replace(recording, display_exposure=stream_exposure(stream))
    return as_fitted(recording, stream) if "distortions" in stream.metadata else recording


def fitted_capture(stream: FrameSource) -> str:
    """Return the path of a stream's capture, which is in the `capture.json` beside it.

    Raises:
        FileNotFoundError: no path is stored, or the folder is not there any more.
    """
    path = None
    with suppress(OSError, ValueError, LookupError, TypeError):
        path = read_json(stream.path.with_name(CAPTURE))["capture"]
    if isinstance(path, str) and Path(path).is_dir():
        return path
    raise FileNotFoundError(
        f"{stream.path}: expected the path of its capture in the capture.json beside it, found "
        f"{path or 'none'}; if it has moved, name its folder with --capture."
    )


def between_cameras(stream: FrameSource) -> str:
    """Return the quality to expect of views between the cameras, such as ``poor (58 degrees
    apart)``, from the report of the fit beside a stream; empty without one.
    """
    with suppress(OSError, ValueError, LookupError, TypeError, OverflowError):
        expected = read_json(stream.path.with_name(REPORT))["frames"][0]["validation"]
        return f"{expected['quality']} ({float(expected['spacing']):.0f} degrees apart)"
    return ""


def as_fitted(capture: Capture, stream: FrameSource) -> Capture:
    """Return a capture with the cameras of a stream, which its fit may have refined.

    Raises:
        ValueError: the distortions in the stream's header are no pairs of numbers.
    """
    distortions = metadata_entry(stream, "distortions")
    terms = [distortions.get(name, (0.0, 0.0)) for name in capture.names]
    return capture.with_cameras(capture.with_delays(stream.cameras), terms)


def about_lenses(capture: Capture) -> JsonObject:
    """Return the entries of a stream's header that `as_fitted` reads, none where no distortion was
    refined.
    """
    views = capture.views
    distortions = {view.name: list(view.distortion) for view in views if any(view.distortion)}
    return {"distortions": distortions} if distortions else {}

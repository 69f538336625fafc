"""Fitting a whole capture into a stream file, packet by packet.

A fit may be killed at any instruction. The file then holds complete packets and perhaps a part of the next one. A
frame's row is written to the report before its packet is written to the stream, so that every packet has a row. Nothing
else is stored, because the state of the loop follows from the stream and the recording (see `StreamState`).

A stream is made to be shared, so its header has no paths; where the capture is stands in the `capture.json` beside it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from itertools import chain, islice
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import mitsuba as mi
import numpy as np

from morgs_mi.calibration.refine import Refinement, refine_cameras, register_camera
from morgs_mi.calibration.rig_check import dense_points, match_capture
from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.capture.outputs import check_output
from morgs_mi.codec.container import Packet, PacketKind, StreamWriter, TruncatedStreamError, header_json
from morgs_mi.codec.packets import CodedFrame, reemitted_keyframe, seek
from morgs_mi.codec.reader import StreamReader
from morgs_mi.config import StreamConfig
from morgs_mi.core.files import is_same_file, locked_folder, write_json
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.progress import Progress, Report
from morgs_mi.fit.initialise import scene_extent
from morgs_mi.fit.view import View, mean_psnr
from morgs_mi.io.bounded import read_json
from morgs_mi.method.exposure import Exposure
from morgs_mi.method.flow import choose_key_views
from morgs_mi.stream_loop import FrameReport, StreamLoop

__all__ = [
    "FILES",
    "about_cameras",
    "about_lenses",
    "as_fitted",
    "check_same_fit",
    "described_capture",
    "due_keyframe",
    "push_frame",
    "read_reports",
    "stream_capture",
    "stream_metadata",
    "with_next",
    "with_points",
    "with_refined_cameras",
]

FILES = ("stream.morgs", "capture.json", "report.json")
"""Names of the files that a fit writes into its folder."""

# Fewer points are replaced by triangulated ones, if there are more of those.
_FEW_POINTS = 100


def stream_capture(
    capture: Capture,
    out: str | Path,
    config: StreamConfig | None = None,
    resume: bool = False,
    progress: Report | None = None,
) -> list[FrameReport]:
    """Fit a whole capture and write OUT/stream.morgs packet by packet, and OUT/report.json with every frame.

    OUT/capture.json has the capture's path and describes how it was read. Points are triangulated where a capture has
    too few. OUT is locked meanwhile.

    Args:
        capture: cameras and frames; the test view is not trained on, but is part of the stream's header.
        out: folder, made if missing.
        config: settings.
        resume: continue after the last complete packet of the stream in `out`, if there is one. With
            `RenderConfig(reproducible=True)` the stream has the same bytes as without an interruption.
        progress: called with (stage, done, total): matching views, trials, the first frame, later frames.

    Returns:
        The reports of all frames, including those before an interruption.

    Raises:
        OSError: the disk is full or not writable, another fit writes into OUT, or the stream was removed, moved or
        replaced meanwhile; the stream is complete up to the last frame.
        ValueError: as `StreamLoop`; OUT lies in a capture; or the stream to resume is damaged, or belongs to another
        capture or other settings.
    """
    out = Path(out)
    for name in FILES:
        check_output(out / name)
    with locked_folder(out, "stream_capture()"):
        return _stream(capture, out, config or StreamConfig(), resume, Progress(progress))


def _stream(
    capture: Capture,
    out: Path,
    config: StreamConfig,
    resume: bool,
    progress: Progress,
) -> list[FrameReport]:
    """Fit a capture into a locked folder."""
    path, train, frames = out / "stream.morgs", capture.train_views, capture.partial_frames()
    first = next(frames)
    metadata = stream_metadata(capture, first, config)
    interrupted = _interrupted(out, capture, metadata) if resume else None
    refinement = None
    if interrupted is None:
        capture, refinement = with_refined_cameras(with_points(capture, config.seed, progress), config, progress)
        metadata |= about_lenses(capture)
    else:
        capture = interrupted.capture
    loop = StreamLoop(
        [capture.cameras[v] for v in train],
        capture.points,
        capture.point_colors,
        config,
        [capture.masks[v] for v in train],
    )
    about = described_capture(capture, None if interrupted is None else out / "capture.json")
    if interrupted is None:
        write_json(out / "capture.json", about)
        writer, reports = StreamWriter(path, capture.cameras, capture.fps, metadata), []
        frames = chain((first,), frames) if refinement is None else capture.partial_frames()
    else:
        # Changes and exposures are relative to references that depend on all images so far.
        now = interrupted.coded.frame
        start = 0 if config.fit.skip_static or config.fit.exposure != "off" else now
        frames = capture.partial_frames(start)
        count = now + 1 - start
        past = _reported(islice(frames, count), progress.of("Reading the fitted frames"), count)
        images = (frame.comparable(train) for frame in past)
        loop.resume(interrupted.coded, images, interrupted.reports[0].exposures)
        write_json(out / "capture.json", about)
        writer = StreamWriter.continued(path, interrupted.index, interrupted.end)
        reports = interrupted.reports
    interval, written, last = config.codec.keyframe_interval, os.stat(path), capture.num_frames - 1
    with writer:
        if interrupted is not None and interrupted.index[-1][0] == PacketKind.RESIDUAL:
            for packet in due_keyframe(interrupted.coded, interval):
                writer.write(packet)
        for frame, upcoming in with_next(frames):
            stage = progress.of("Later frames").part(frame.index - 1, last) if frame.index else progress
            packet, report = push_frame(loop, frame, train, stage.report, upcoming)
            if refinement is not None and not frame.index:
                assert loop.gaussians is not None
                about = about_cameras(loop.gaussians, capture, frame, refinement, config)
                report = replace(report, validation=report.validation | about)
            reports.append(report)
            _check_in_place(path, written)
            write_json(out / "report.json", {**metadata, "frames": [asdict(r) for r in reports]})
            for due in (packet, *due_keyframe(loop.state.coded, interval)):
                writer.write(due)
    _check_in_place(path, written)
    return reports


def with_points(capture: Capture, seed: int, progress: Progress) -> Capture:
    """Return a capture with the points of `dense_points` if it has few and they are more; see `stream_capture`."""
    if len(capture.points) >= _FEW_POINTS:
        return capture
    shared = match_capture(capture, progress.of("Matching views"))
    progress.of("Triangulating points")(0, 1)
    return max(capture, dense_points(capture, shared, seed), key=lambda c: len(c.points))


def with_refined_cameras(
    capture: Capture, config: StreamConfig, progress: Progress
) -> tuple[Capture, Refinement | None]:
    """Return a capture with refined cameras where the config asks for them, and what was found."""
    if config.fit.refine_cameras == "off":
        return capture, None
    return refine_cameras(capture, config.fit, config.render, config.seed, progress.of("Refining cameras"))


def about_cameras(
    gaussians: Gaussians, capture: Capture, frame: PartialFrame, found: Refinement, config: StreamConfig
) -> dict[str, Any]:
    """Return what the first frame's report says about the cameras, and of the held-out view if there is one."""
    about, test = {**asdict(found), "sentence": found.sentence}, capture.test_view
    image = None if test is None else frame.images[test]
    if test is None or image is None:
        return {"refinement": about}
    view, given = (image, capture.masks[test]), capture.cameras[test]
    extent = scene_extent([capture.cameras[v] for v in capture.train_views])
    registered = register_camera(gaussians, given, *view, extent, config.fit, config.render)
    psnr = [mean_psnr(gaussians, [View(camera, *view)], config.render) for camera in (given, registered)]
    return {"refinement": {**about, "held_out": {"calibrated_psnr": psnr[0], "registered_psnr": psnr[1]}}}


def push_frame(
    loop: StreamLoop,
    frame: PartialFrame,
    train: Sequence[int],
    progress: Report | None = None,
    upcoming: PartialFrame | None = None,
) -> tuple[Packet, FrameReport]:
    """Fit the next frame of a loop on the views `train`; the report's status names the images that are missing."""
    images, ahead = (None if f is None else [f.images[v] for v in train] for f in (frame, upcoming))
    assert images is not None
    recorded = None if frame.recorded is None else frame.comparable(train)
    packet, report = loop.push(images, progress, ahead, recorded)
    status = "; ".join([*([report.status] if report.status != "ok" else []), *frame.problems]) or "ok"
    return packet, replace(report, status=status)


def with_next(frames: Iterable[PartialFrame]) -> Iterator[tuple[PartialFrame, PartialFrame | None]]:
    """Yield each frame with the one after it, which is None for the last; raise what reading that one raised after."""
    frames = iter(frames)
    frame = next(frames, None)
    while frame is not None:
        upcoming, problem = None, None
        try:
            upcoming = next(frames, None)
        except Exception as error:
            problem = error
        yield frame, upcoming
        if problem is not None:
            raise problem
        frame = upcoming


def _reported(frames: Iterable[PartialFrame], progress: Progress, count: int) -> Iterator[PartialFrame]:
    """Yield frames and report how many were there before."""
    for done, frame in enumerate(frames):
        progress(done, count)
        yield frame


def _check_in_place(path: Path, written: os.stat_result) -> None:
    """Raise `FileNotFoundError` if the stream that is being written has been removed, moved or replaced."""
    if not is_same_file(path, written):
        found = "another file" if path.exists() else "none"
        raise FileNotFoundError(
            f"{path}: expected the stream that is being written, found {found}: it was removed, moved or replaced; "
            "start again, or resume it where it is now."
        )


@dataclass(frozen=True, eq=False)
class _Interrupted:
    """An interrupted stream.

    Attributes:
        index: (kind, frame, offset) of its complete packets.
        end: offset of the end of the last one.
        coded: state after it.
        reports: of the frames.
        capture: with the cameras of its header.
    """

    index: list[tuple[int, int, int]]
    end: int
    coded: CodedFrame
    reports: list[FrameReport]
    capture: Capture


def _interrupted(out: Path, capture: Capture, metadata: Mapping[str, Any]) -> _Interrupted | None:
    """Return the stream in `out` up to its last complete packet, None if there is none yet.

    Raises:
        ValueError: it is damaged, or does not belong to the capture or the settings.
    """
    try:
        stream = StreamReader(out / "stream.morgs")
    except (FileNotFoundError, TruncatedStreamError):
        return None
    check_same_fit(stream, capture, metadata)
    index, end = stream.check()
    if not index:
        return None
    coded = seek(stream, index[-1][1])
    reports = read_reports(out / "report.json", range(coded.frame + 1))
    return _Interrupted(index, end, coded, reports, as_fitted(capture, stream))


def as_fitted(capture: Capture, stream: StreamReader) -> Capture:
    """Return a capture with the cameras of a stream, whose fit may have refined them.

    Raises:
        ValueError: the distortions in the stream's header are no pairs of numbers.
    """
    found, expected = stream.metadata.get("distortions", {}), "an object with two numbers for each camera"
    try:
        terms = np.array([found.get(name, (0, 0)) for name in capture.names], np.float64)
    except (AttributeError, TypeError, ValueError):
        terms = np.full((1, 1), np.nan)
    if terms.shape[1:] != (2,) or not np.isfinite(terms).all():
        raise ValueError(f"{stream.path}: packet 0: `distortions` must be {expected}; fit the capture again.")
    return capture.with_cameras(capture.with_delays(stream.cameras), terms.tolist())


def about_lenses(capture: Capture) -> dict[str, Any]:
    """Return the entries of a stream's header that `as_fitted` reads, none where no distortion was refined."""
    named = zip(capture.names, capture.distortions, strict=bool(capture.distortions))
    terms = {name: list(terms) for name, terms in named if any(terms)}
    return {"distortions": terms} if terms else {}


def check_same_fit(stream: StreamReader, capture: Capture, metadata: Mapping[str, Any]) -> None:
    """Check that a stream to resume has the header that a fit would write.

    Raises:
        ValueError: it belongs to another capture or other settings.
    """
    # Streams of earlier versions have paths in their headers.
    found = ("capture", "distortions")
    recorded = _without_folders({name: value for name, value in stream.metadata.items() if name not in found})
    # Refined cameras differ from the calibrated ones, which are part of the fingerprint then.
    refined = metadata["config"]["fit"]["refine_cameras"] != "off"
    cameras = stream.cameras if refined else capture.cameras
    old, new = (
        json.loads(header_json(*parts))
        for parts in ((stream.cameras, stream.fps, recorded), (cameras, capture.fps, metadata))
    )
    if difference := _difference(old, new):
        name, before, now = difference
        raise ValueError(
            f"{stream.path}: expected to resume a fit with {name} = {shortened(before)}, got {shortened(now)}; give "
            "the same capture and settings, or start again without --resume."
        )


def stream_metadata(capture: Capture, first: PartialFrame, config: StreamConfig) -> dict[str, Any]:
    """Return the entries of the stream's header about the fit; they must agree for a fit to be resumed."""
    train = capture.train_views
    key_views = choose_key_views([capture.cameras[v] for v in train], config.motion.key_views)
    calibrated = () if config.fit.refine_cameras == "off" else [m for c in capture.cameras for m in (c.K, c.viewmat)]
    metadata = {
        "fingerprint": _fingerprint([*first.images, capture.points, capture.point_colors, *calibrated]),
        "downscale": capture.downscale,
        "test_view": capture.test_view,
        "reading": asdict(capture.reading),
        "train_views": list(train),
        "num_frames": capture.num_frames,
        "key_views": [train[v] for v in key_views],
        "config": asdict(config),
        "versions": {"mitsuba": mi.__version__},
        "variant": mi.variant(),
    }
    return _without_folders(metadata)


def _without_folders(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return a header's metadata with methods such as ``onnx:FILE`` that have the names of their files alone."""
    match metadata:
        case {"config": {"motion": {"flow_method": str(flow), "mask_method": str(masks)} as motion} as config}:
            motion = {**motion, "flow_method": _without_folder(flow), "mask_method": _without_folder(masks)}
            return {**metadata, "config": {**config, "motion": motion}}
    return dict(metadata)


def _without_folder(method: str) -> str:
    kind, colon, files = method.partition(":")
    return kind + colon + ",".join(Path(file).name for file in files.split(","))


def described_capture(capture: Capture, earlier: Path | None) -> dict[str, Any]:
    """Return the content of `capture.json`: that of an earlier fit if there is one, with the capture's present path."""
    about = None
    if earlier is not None:
        with suppress(OSError, ValueError):
            about = read_json(earlier)
    return {**(about if isinstance(about, dict) else capture.metadata()), "capture": str(Path(capture.path).resolve())}


def _fingerprint(arrays: Iterable[np.ndarray | None]) -> str:
    """Return a digest of a recording's first images and its points, to recognise another recording in its place."""
    digest = blake2b(digest_size=8)
    for array in arrays:
        digest.update(b"" if array is None else np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _difference(old: Any, new: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Return (name, old, new) of the first entry in which two JSON values differ, None if they are equal."""
    if isinstance(old, dict) and isinstance(new, dict):
        pairs = (_difference(old.get(key), new.get(key), f"{name}.{key}".lstrip(".")) for key in {**old, **new})
        return next(filter(None, pairs), None)
    return None if old == new else (name, old, new)


def read_reports(path: Path, frames: range) -> list[FrameReport]:
    """Return the reports of the first frames of a file, which are `frames`."""
    remedy = "start again without --resume"
    document = read_json(path) if path.exists() else {}
    try:
        reports = [_report(row) for row in document["frames"][: len(frames)]]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        found = f"a broken one ({error})" if path.exists() else "none"
        raise ValueError(f"{path}: expected the report of the fit, got {found}; {remedy}.") from None
    if [report.frame for report in reports] != list(frames):
        raise ValueError(f"{path}: expected the rows of {len(frames)} frames, got {len(reports)}; {remedy}.")
    return reports


def _report(row: Mapping[str, Any]) -> FrameReport:
    exposures = tuple(Exposure(tuple(e["gain"]), tuple(e["bias"])) for e in row.get("exposures", ()))
    known = {"seconds": float(row["seconds"]), "missing_views": tuple(row["missing_views"]), "exposures": exposures}
    return FrameReport(**{**row, **known})


def due_keyframe(coded: CodedFrame | None, interval: int) -> list[Packet]:
    """Return the state as a keyframe where one is due."""
    if coded is None or not interval or not coded.frame or coded.frame % interval:
        return []
    return [reemitted_keyframe(coded)]

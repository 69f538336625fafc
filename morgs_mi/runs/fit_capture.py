"""Fitting a whole capture into a stream file, packet by packet."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.capture.fingerprint import image_fingerprints
from morgs_mi.capture.points import dense_points, match_capture, triangulate_points
from morgs_mi.codec.container import Packet
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.view import View, Views
from morgs_mi.fit.budget import check_capacity
from morgs_mi.fit.initialise import unseen_points
from morgs_mi.loop.first_frame import preview
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.observation import over_border, prepare
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.extras import extra
from morgs_mi.platform.files import locked_folder
from morgs_mi.platform.interrupts import interrupts_raised
from morgs_mi.platform.progress import Progress, Report, time_left
from morgs_mi.playback.stream_header import about_lenses, as_fitted
from morgs_mi.runs.fit_files import (
    FitFiles,
    Interrupted,
    ProvisionalFrame,
    Recording,
    check_outputs,
    interrupted_fit,
    read_reports,
    stream_metadata,
)
from morgs_mi.stream_loop import StreamLoop

_LOG = logging.getLogger(__name__)
# Fewer points are replaced by triangulated ones, if there are more of those.
_FEW_POINTS = 100


@dataclass
class FirstFrameProgress:
    """Report that also notes the progress of the first frame, which viewers show."""

    report: Report | None  #: Called likewise.
    begin: float = field(default_factory=time.perf_counter)  #: Of the fit, s.
    first_step: float | None = None  #: Begin of the first frame's first step, s.
    left: float | None = None  #: Seconds of the steps that are left; None before 3 %.

    def __call__(self, stage: str, done: float, total: float) -> None:
        if stage.startswith("First frame"):
            moment = time.perf_counter()
            self.first_step = self.first_step or moment
            self.left = time_left(moment - self.first_step, done, total)
        if self.report is not None:
            self.report(stage, done, total)


@interrupts_raised()
def stream_capture(
    capture: Capture,
    out: str | Path,
    config: StreamConfig | None = None,
    resume: bool = False,
    progress: Report | None = None,
    on_provisional: Callable[[Packet], None] | None = None,
) -> list[FrameReport]:
    """Fit a whole capture and write OUT/stream.morgs packet by packet, and OUT/report.json with
    every frame.

    OUT/capture.json has the capture's path and describes how it was read. Points are triangulated
    where a capture has too few, or has points that its cameras do not see. OUT is locked meanwhile.

    Args:
        capture: cameras and frames; the test view is not trained on, but is part of the stream's
            header.
        out: folder, made if missing. The files of an earlier fit stay there until the first frame
            replaces them.
        config: settings.
        resume: continue after the last complete packet of the stream in `out`, if there is one.
            The stream has the same bytes as without an interruption.
        progress: called with (stage, done, total): matching views, the first frame, later frames.
        on_provisional: called with provisional keyframes while the first frame is fitted, after
            they are written beside the stream.

    Returns:
        The reports of all frames, including those before an interruption.

    Raises:
        OSError: the disk is full or not writable, another fit writes into OUT, no image of a frame
            can be read, or the stream was removed, moved or replaced meanwhile; the stream is
            complete up to the last frame.
        ValueError: as `StreamLoop`; OUT lies in a capture; or the stream to resume is damaged, or
            belongs to another capture or other settings; or images, Gaussians or steps that do not
            fit in memory.
    """
    out = Path(out)
    config = config_or_default("stream_capture()", config, StreamConfig())
    check_outputs(out)
    check_capacity("stream_capture()", capture.views.train.cameras, config.fit)
    watched = FirstFrameProgress(progress)
    stages = Progress(watched)
    with locked_folder(out, "stream_capture()"), ExitStack() as at_end:
        files = FitFiles.of(out)
        at_end.callback(files.provisional.unlink, missing_ok=True)
        first_frame = next(capture.partial_frames(0, 1))
        config = with_border(capture, first_frame, config)
        metadata = stream_metadata(capture, first_frame, config)
        provisional = ProvisionalFrame(files.provisional, capture, metadata)

        def show(keyframe: Packet) -> None:
            seconds = time.perf_counter() - watched.begin
            provisional.show(keyframe, {"seconds": seconds, "left": watched.left})
            if on_provisional is not None:
                on_provisional(keyframe)

        def show_preview(sparse: Capture) -> None:
            setup = StreamLoop.of(sparse, config).setup
            preview(setup, first_frame.comparable, stages.of("First picture"), show)

        earlier = interrupted_fit(files, capture, metadata) if resume else None
        if earlier is None:
            prepared = Prepared.of(capture, config, stages, show_preview)
            loop = StreamLoop.of(prepared.capture, config)
            frames = prepared.capture.partial_frames()
        else:
            prepared = Prepared(as_fitted(capture, earlier.stream))
            loop = StreamLoop.of(prepared.capture, config)
            frames = _resumed(loop, prepared.capture, earlier, stages)
        last = prepared.capture.num_frames - 1
        later_frames = stages.of("Later frames")
        metadata |= about_lenses(prepared.capture)
        provisional.capture = prepared.capture
        with Recording(files, prepared.capture, metadata, earlier) as recording:
            for frame, upcoming in with_next(frames):
                stage = later_frames.part(frame.index - 1, last) if frame.index else stages
                packet, report = push_frame(loop, frame, stage.report, upcoming, show)
                report = prepared.completed(report)
                report = replace(report, fingerprints=image_fingerprints(frame.images))
                recording.push(packet, report, loop.state.coded)
        return recording.reports


def _resumed(
    loop: StreamLoop, capture: Capture, earlier: Interrupted, progress: Progress
) -> Iterator[PartialFrame]:
    """Let a loop continue after an interrupted fit, and return the frames that follow."""
    fit = loop.setup.config.fit
    last_frame = earlier.coded.frame
    # Changes and exposures are relative to references that depend on all images so far.
    start = 0 if fit.skip_static or fit.exposure != "off" else last_frame
    frames = capture.partial_frames(start)
    count = last_frame + 1 - start
    reading = progress.of("Reading the fitted frames")

    def images() -> Iterator[Views[View]]:
        for done, frame in enumerate(islice(frames, count)):
            reading(done, count)
            yield frame.comparable

    loop.resume(earlier.coded, images(), earlier.reports[0].exposures)
    return frames


@dataclass(frozen=True, eq=False)
class Prepared:
    """A capture that is ready to be fitted."""

    #: With enough points, and with refined cameras where the settings ask for them.
    capture: Capture
    #: `refinement` with the changes of the cameras and their gain; empty if they are the
    #: calibration's.
    validation: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        capture: Capture,
        config: StreamConfig,
        progress: Progress,
        on_sparse: Callable[[Capture], None] | None = None,
    ) -> Prepared:
        """Return a capture with triangulated points where it has few, and with refined cameras
        where asked for; arguments as for `with_points`.
        """
        capture = with_points(capture, config.seed, progress, on_sparse)
        if config.fit.refine_cameras == "off":
            return cls(capture)
        stage = progress.of("Refining cameras")
        refine_cameras = extra("cameras", "refine")
        capture, refinement = refine_cameras(capture, config.fit, config.render, config.seed, stage)
        return cls(capture, {"refinement": refinement.as_dict()})

    def completed(self, report: FrameReport) -> FrameReport:
        """Return the report of a frame; the first one includes the findings about the cameras."""
        if report.frame:
            return report
        return replace(report, validation=report.validation | self.validation)


def begin_as(source: Path, out: Path, capture: Capture, metadata: dict[str, Any]) -> None:
    """Write the first frame of the fit in the folder `source` into the folder `out`, for a fit of
    the same capture with other settings to resume; `metadata` is of that fit, see
    `stream_metadata`.
    """
    files = FitFiles.of(source)
    stream = StreamReader(files.stream)
    rig = as_fitted(capture, stream)
    out.mkdir(exist_ok=True)
    with Recording(FitFiles.of(out), rig, metadata | about_lenses(rig)) as recording:
        recording.extend([next(iter(stream))], read_reports(files.report, range(1)))


def with_border(capture: Capture, first: PartialFrame, config: StreamConfig) -> StreamConfig:
    """Return the settings of a fit of a capture, without points and a background with that of its
    first frame (see `over_border`).
    """
    cloud = capture.points, capture.point_colors
    setup = prepare(capture.views.train, *cloud, config, capture.display_exposure)
    return over_border(setup, first.train).config


def with_points(
    capture: Capture,
    seed: int,
    progress: Progress,
    on_sparse: Callable[[Capture], None] | None = None,
) -> Capture:
    """Return a capture with the points of `dense_points` if it has few and they are more; points
    that hardly a training camera sees are not counted, with a warning. See `stream_capture`.

    Args:
        capture: a capture.
        seed: of the selection of points.
        progress: of the stages.
        on_sparse: called with the capture with triangulated points alone, if they are more.
    """
    if problem := unseen_points(capture.views.train.cameras, capture.points):
        _LOG.warning("%s: %s.", capture.path, problem)
        none = np.zeros((0, 3))
        capture = replace(capture, points=none, point_colors=none)
    if len(capture.points) >= _FEW_POINTS:
        return capture
    shared = match_capture(capture, progress.of("Matching views"))
    sparse = triangulate_points(capture, shared)
    if on_sparse is not None and len(sparse.points) > len(capture.points):
        on_sparse(sparse)
    progress.of("Triangulating points")(0, 1)
    return max(capture, dense_points(capture, sparse, seed), key=lambda c: len(c.points))


def push_frame(
    loop: StreamLoop,
    frame: PartialFrame,
    progress: Report | None = None,
    upcoming: PartialFrame | None = None,
    on_provisional: Callable[[Packet], None] | None = None,
) -> tuple[Packet, FrameReport]:
    """Fit the next frame of a loop; the report's status names the images that are missing.

    Raises:
        OSError: none of them could be read.
        ValueError: as `StreamLoop.push`.
    """
    ahead = None if upcoming is None else upcoming.views.train
    recorded = None if frame.recorded is None else frame.comparable
    packet, report = loop.push(frame.train, progress, ahead, recorded, on_provisional)
    problems = [report.status] if report.status != "ok" else []
    return packet, replace(report, status="; ".join([*problems, *frame.problems]) or "ok")


def with_next(frames: Iterable[PartialFrame]) -> Iterator[tuple[PartialFrame, PartialFrame | None]]:
    """Yield each frame with the one after it, which is None for the last; raise what reading that
    one raised after.
    """
    frames = iter(frames)
    frame = next(frames, None)
    while frame is not None:
        upcoming = None
        problem = None
        try:
            upcoming = next(frames, None)
        except Exception as error:
            problem = error
        yield frame, upcoming
        if problem is not None:
            raise problem
        frame = upcoming

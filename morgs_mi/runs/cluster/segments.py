"""A fit in segments: stretches of a recording that are fitted side by side and joined into one stream.

While it runs, OUT/segments has a stream and a report for each segment, to which the frames of each finished task are
added. They are joined into OUT/stream.morgs at the end. Resuming continues every segment after its last frame.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.container import Packet, PacketKind, StreamWriter, TruncatedStreamError, decode_packet
from morgs_mi.codec.packets import decode, reemitted_keyframe, seek
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.files import locked_folder, write_json
from morgs_mi.core.progress import Progress, Report
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.playback.source import about_lenses, as_fitted
from morgs_mi.runs.cluster.executor import Workers
from morgs_mi.runs.cluster.seams import COMMON_FRAMES, SeamScores, SegmentConfig, score_seam
from morgs_mi.runs.cluster.tasks import (
    Fit,
    Following,
    FrameRange,
    Part,
    Points,
    Source,
    fit_frames,
    fit_segment_start,
    installed,
)
from morgs_mi.runs.recorder import Prepared
from morgs_mi.runs.recording import (
    Entry,
    FitFiles,
    Interrupted,
    Recording,
    check_outputs,
    check_same_fit,
    described_capture,
    interrupted_fit,
    read_reports,
    restart_of,
    stream_metadata,
)
from morgs_mi.stream_loop import FrameReport

__all__ = ["SegmentedFit", "SegmentedRun", "noting_segments"]

FOLDER = "segments"
# Frames of a task: a few tasks are lost if a worker dies, and the progress is known that finely.
TASK_FRAMES = 10
_MIN_FRAMES = 2  # of a segment
_POLL = 0.1  # seconds between two looks for a worker that is free; their number may grow


@dataclass(frozen=True)
class SegmentedFit:
    """Result of a fit in segments.

    Attributes:
        reports: of all frames.
        seams: scores of the seams.
        workers: peak memory of the workers by their names, bytes.
    """

    reports: tuple[FrameReport, ...]
    seams: tuple[SeamScores, ...] = ()
    workers: Mapping[str, int] = field(default_factory=dict)


@contextmanager
def noting_segments(out: Path) -> Iterator[None]:
    """Add to an interruption or a failure how many frames the segments of a fit in `out` hold."""
    try:
        yield
    except (KeyboardInterrupt, OSError, MemoryError) as error:
        streams = sorted((out / FOLDER).glob("[0-9]*.morgs"))
        with suppress(OSError, ValueError):
            count = sum(map(_num_finished, streams))
            if count:
                error.add_note(f"{out / FOLDER} holds {count} frames; continue with `--resume`.")
        raise


def _num_finished(path: Path) -> int:
    """Return the number of frames in the stream of a segment, without the overlap before it."""
    stream = StreamReader(path)
    start = stream.metadata.get("segments", {"starts": [0]})["starts"][int(path.stem)]
    return len({frame for _, frame, _ in stream.index() if frame >= start})


def _remove(folder: Path) -> None:
    """Remove a folder, if there is one; after a kill it has all its files, or another name."""
    removed = folder.with_name(f".removed-{folder.name}")
    shutil.rmtree(removed, ignore_errors=True)
    with suppress(FileNotFoundError):
        folder.rename(removed)
    shutil.rmtree(removed, ignore_errors=True)


def _starts(num_frames: int, segments: int) -> list[int]:
    """Return the first frames of segments of about the same length, and the number of frames."""
    most = max(1, num_frames // _MIN_FRAMES)
    if not 1 <= segments <= most:
        raise ValueError(
            f"SegmentedRun(): `segments` must be 1 to {most} for {num_frames} frames, {_MIN_FRAMES} for each, got "
            f"{segments}."
        )
    return np.linspace(0, num_frames, segments + 1).round().astype(int).tolist()


class SegmentedRun:
    """A fit of a capture in segments, side by side, into the files that `stream_capture` writes.

    Args:
        capture: a capture from `load_capture`, at a path that all workers see.
        out: folder, made if missing.
        workers: from `open_workers`; several runs may share them.
        config: settings.
        segments: their number and the settings of the seams; None: one segment.
        on_stage: called with (name of the stage, done, total).

    Example:
        >>> fit = wait_for(SegmentedRun(capture, out, workers, config, SegmentConfig(3)).fit())

    Raises:
        ValueError: there are more segments than pairs of frames.
    """

    def __init__(
        self,
        capture: Capture,
        out: str | Path,
        workers: Workers,
        config: StreamConfig,
        segments: SegmentConfig | None = None,
        on_stage: Report | None = None,
    ) -> None:
        segments = segments or SegmentConfig()
        self.capture, self.out, self.workers = capture, Path(out), workers
        self.on_stage: Report = on_stage or (lambda *_: None)
        self.starts = _starts(capture.num_frames, segments.count)
        self.task = Fit(Source.of(capture), config, segments, str(mi.variant()), installed())
        self.metadata = stream_metadata(capture, next(capture.partial_frames(0, 1)), config)
        if segments.count > 1:
            self.metadata["segments"] = {"starts": self.starts[:-1], **asdict(segments)}
        self.prepared: Prepared | None = None  # where this run begins the recording
        self.peaks: dict[str, int] = {}
        self.active = 0  # segments with later frames being fitted
        self.starting = 0  # segments with a start that is being fitted, or waits for a worker

    async def fit(self, resume: bool = False) -> SegmentedFit:
        """Fit, or continue, all segments and join them.

        Args:
            resume: continue the segments in `out`. With `RenderConfig(reproducible=True)` the stream has the same bytes
                as without an interruption.

        Raises:
            OSError: as `stream_capture`, a worker died several times, or the scheduler was lost. The finished frames
                stay.
            ValueError: as `stream_capture`.
        """
        check_outputs(self.out)
        with locked_folder(self.out, "SegmentedRun.fit()"):
            with ExitStack() as self.recordings:
                if (reports := await self._fit_all(resume)) is not None:
                    return SegmentedFit(tuple(reports))
            return self._joined(FitFiles.of(self.out))

    async def _fit_all(self, resume: bool) -> list[FrameReport] | None:
        """Fit what is missing of the segments; return the reports of all frames if they had been joined before."""
        folder, path = self.out / FOLDER, self.out / "stream.morgs"
        if resume and not folder.exists() and (reports := self._complete(path)):
            return reports
        if not resume:
            _remove(folder)
        folder.mkdir(exist_ok=True)
        self.segments = [_Segment(self, k) for k in range(len(self.starts) - 1)]
        points = None
        if not self.segments[0].num_fitted:
            self.prepared = Prepared.of(self.capture, self.task.config, Progress(self.on_stage))
            capture = self.prepared.capture
            points = None if capture is self.capture else (capture.points, capture.point_colors)
            self._use(capture)
        elif self.task.config.fit.refine_cameras != "off":
            self._use(as_fitted(self.capture, StreamReader(self.segments[0].files.stream)))
        loop = asyncio.get_running_loop()
        self.base: asyncio.Future[tuple[bytes, int]] = loop.create_future()  # common model and number of its ids
        self.begun: list[asyncio.Future[tuple[bytes, ...]]] = [loop.create_future() for _ in self.segments]
        self.show_progress()
        try:
            async with asyncio.TaskGroup() as group:
                for segment in self.segments:
                    group.create_task(segment.fit(points))
        except BaseExceptionGroup as errors:
            raise errors.exceptions[0] from None
        return None

    def _use(self, capture: Capture) -> None:
        """Fit with the cameras of a capture."""
        if self.task.config.fit.refine_cameras != "off":
            self.task = replace(self.task, rig=(capture.cameras, capture.distortions))
            self.capture, self.metadata = capture, self.metadata | about_lenses(capture)

    async def run(self, function: Callable[..., Part], *args: Any) -> Part:
        """Return the result of a task on a worker."""
        part = await self.workers.run(function, self.task, *args)
        self.peaks[part.worker] = max(part.peak_bytes, self.peaks.get(part.worker, 0))
        return part

    def show_progress(self) -> None:
        self.on_stage("Fitting frames", sum(s.num_fitted for s in self.segments), self.capture.num_frames)

    def _complete(self, path: Path) -> list[FrameReport] | None:
        """Return the reports of an earlier fit that was finished, None if there is none."""
        try:
            stream = StreamReader(path)
        except (FileNotFoundError, TruncatedStreamError):
            return None
        check_same_fit(stream, self.capture, self.metadata)
        frames = self.capture.num_frames
        if not stream.closed() or stream.index()[-1][1] != frames - 1:
            return None
        return read_reports(self.out / "report.json", range(frames))

    def _joined(self, files: FitFiles) -> SegmentedFit:
        """Join the segments into one stream, with its report and the scores of the seams."""
        reports = [report for segment in self.segments for report in segment.reports]
        new = files.next
        assert new.description is not None
        files.settle()
        try:
            with StreamWriter(new.stream, self.capture.cameras, self.capture.fps, self.metadata) as writer:
                for segment in self.segments:
                    for packet in segment.packets():
                        writer.write(packet)
            scores = []
            for done, frame in enumerate(self.starts[1:-1]):
                self.on_stage("Evaluating seams", done, len(self.starts) - 2)
                scores.append(score_seam(StreamReader(new.stream), self.capture, frame))
            report: dict[str, Any] = {**self.metadata, "frames": [asdict(r) for r in reports]}
            if scores:
                report |= {"seams": [asdict(s) for s in scores], "workers": self.peaks}
            write_json(new.report, report)
            write_json(new.description, described_capture(self.capture, None))
            files.replace_by_next()
        finally:
            files.settle()
        _remove(self.out / FOLDER)
        return SegmentedFit(tuple(reports), tuple(scores), self.peaks)


class _Segment:
    """One segment of a fit: its stream, its report, and the tasks that fit it."""

    def __init__(self, run: SegmentedRun, number: int) -> None:
        self.run, self.number = run, number
        self.start, self.stop = run.starts[number], run.starts[number + 1]
        self.files = FitFiles(run.out / FOLDER / f"{number}.morgs", run.out / FOLDER / f"{number}.json")
        self.restart: tuple[bytes, ...] = ()
        self.recording: Recording | None = None
        earlier = interrupted_fit(self.files, run.capture, run.metadata, self._finished, self.start)
        if earlier is not None:
            self.restart = restart_of(earlier.before, earlier.last)
            self._open(earlier)

    @property
    def reports(self) -> list[FrameReport]:
        """Reports of the frames that are fitted."""
        return [] if self.recording is None else self.recording.reports

    @property
    def num_fitted(self) -> int:
        """Number of frames that are fitted."""
        return len(self.reports)

    @property
    def fade(self) -> int:
        """First of the frames in which the stream fades to the next segment; the end of the last segment."""
        if self.stop == self.run.starts[-1]:
            return self.stop
        first = self.start + 1 if self.number else COMMON_FRAMES
        return min(max(self.stop - self.run.task.segments.overlap, first), self.stop)

    async def fit(self, points: Points | None) -> None:
        """Fit what is missing of the segment, task after task."""
        common = min(COMMON_FRAMES, self.stop)
        if self.number and not self.reports:
            self.run.starting += 1
            keyframe, _ = await self.run.base
            self._add(await self.run.run(fit_segment_start, keyframe, self.start))
            self.run.starting -= 1
        elif not self.number:
            if self.num_fitted < common:
                frames = FrameRange(0, self.num_fitted, common)
                part = await self.run.run(fit_frames, frames, self.restart, None, points)
                self._add(part if self.num_fitted else self._completed(part))
            self.run.task = replace(self.run.task, balance=self.reports[0].exposures)
            coded = seek(StreamReader(self.files.stream), common - 1)
            self.run.base.set_result((reemitted_keyframe(coded).encoded, coded.next_id))
        overlap = takewhile(lambda packet: packet.frame < self.start, StreamReader(self.files.stream))
        self.run.begun[self.number].set_result(tuple(packet.encoded for packet in overlap))
        # A worker continues the loop of one segment, not of many.
        await self._until(lambda: self.run.active < self.run.workers.count)
        self.run.active += 1
        while (at := self.start + self.num_fitted) < self.stop:
            stop, following = min(at + TASK_FRAMES, self.fade), None
            if at == self.fade:  # one task, which alone knows both the faded Gaussians and those that it fits
                _, shared_ids = await self.run.base
                stop, following = self.stop, Following(await self.run.begun[self.number + 1], shared_ids)
            # Starts are the longest tasks, and what other segments wait for: a late one would be fitted last and alone.
            await self._until(lambda: self.run.starting < self.run.workers.count)
            frames = FrameRange(self.start, at, stop)
            self._add(await self.run.run(fit_frames, frames, self.restart, following))
        self.run.active -= 1

    @staticmethod
    async def _until(condition: Callable[[], bool]) -> None:
        while not condition():
            await asyncio.sleep(_POLL)

    def packets(self) -> Iterator[Packet]:
        """Yield the packets of the segment, without the overlap before it."""
        return dropwhile(
            lambda p: (p.kind, p.frame) != (PacketKind.KEYFRAME, self.start), StreamReader(self.files.stream)
        )

    def _finished(self, index: Sequence[Entry], end: int) -> tuple[Sequence[Entry], int]:
        """Return the index and the end of the file without a beginning or a cross-fade that is incomplete."""
        if (PacketKind.KEYFRAME, self.start) not in {(kind, frame) for kind, frame, _ in index}:
            return [], 0
        if not self.fade <= index[-1][1] < self.stop - 1:
            return index, end
        kept = [entry for entry in index if entry[1] < self.fade]
        return kept, index[len(kept)][2]

    def _completed(self, part: Part) -> Part:
        """Return the first part of the recording, with what was found about the cameras in its first report."""
        prepared, config = self.run.prepared, self.run.task.config
        if prepared is None or prepared.refinement is None:
            return part
        coded, frame = decode(None, decode_packet(part.packets[0])), next(prepared.capture.partial_frames(0, 1))
        first = prepared.completed(part.reports[0], coded.gaussians, frame, config)
        return replace(part, reports=(first, *part.reports[1:]))

    def _open(self, earlier: Interrupted | None) -> Recording:
        """Open the files of the segment, which the run closes."""
        recording = Recording(self.files, self.run.capture, self.run.metadata, earlier)
        self.recording = self.run.recordings.enter_context(recording)
        return recording

    def _add(self, part: Part) -> None:
        """Add the frames of a task."""
        recording = self.recording or self._open(None)
        recording.extend(map(decode_packet, part.packets), part.reports)
        self.restart = part.restart
        self.run.show_progress()

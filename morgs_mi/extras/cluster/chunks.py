"""A fit in chunks: parts of a recording that are fitted side by side and joined into one
stream.

While it runs, OUT/chunks has a stream and a report for each chunk, to which the frames of each
finished task are added. They are joined into OUT/stream.morgs at the end. Resuming continues every
chunk after its last frame.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.codec.container import decode_packet
from morgs_mi.codec.packets import reemitted_keyframe
from morgs_mi.codec.reader import StreamReader
from morgs_mi.extras.cluster.tasks import (
    COMMON_FRAMES,
    Chunk,
    ChunkConfig,
    Fit,
    Part,
    fit_frames,
    recording_of,
)
from morgs_mi.extras.cluster.workers import installed, num_workers
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.checks import quantity, require
from morgs_mi.platform.files import locked_folder
from morgs_mi.platform.interrupts import interrupts_raised
from morgs_mi.platform.progress import Progress, Report
from morgs_mi.playback.stream_header import about_lenses, as_fitted
from morgs_mi.runs.fit_capture import Prepared, with_border
from morgs_mi.runs.fit_files import (
    FitFiles,
    Interrupted,
    Recording,
    check_outputs,
    interrupted_fit,
    stream_metadata,
)

if TYPE_CHECKING:
    from distributed import Client, Future

FOLDER = "chunks"
# Frames of a task, two at least: they are lost if a worker dies, and the progress is known that
# finely.
TASK_FRAMES = 10
_MIN_FRAMES = 2  # of a chunk
_ONE_CHUNK = ChunkConfig()
_LOG = logging.getLogger(__name__)


@contextmanager
def noting_chunks(out: Path) -> Iterator[None]:
    """Add to an interruption or a failure how many frames the chunks of a fit in `out` hold."""
    try:
        yield
    except (KeyboardInterrupt, OSError, MemoryError) as error:
        streams = sorted((out / FOLDER).glob("[0-9]*.morgs"))
        with suppress(OSError, ValueError):
            count = sum(len(StreamReader(path).frame_numbers()) for path in streams)
            if count:
                frames = quantity(count, "frame")
                error.add_note(f"{out / FOLDER} holds {frames}; continue with `--resume`.")
        raise


def _remove(folder: Path) -> None:
    """Remove a folder, if there is one; after a kill it has all its files, or another name."""
    trash = folder.with_name(f".removed-{folder.name}")
    shutil.rmtree(trash, ignore_errors=True)
    with suppress(FileNotFoundError):
        folder.rename(trash)
    shutil.rmtree(trash, ignore_errors=True)


class ChunkedRun:
    """A fit of a capture in chunks, side by side, into the files that `stream_capture` writes.

    Args:
        capture: a capture from `load_capture`, at a path that all workers see.
        out: folder, made if missing.
        client: from `open_client`.
        config: settings.
        chunks: their number and the settings of the boundaries.
        on_stage: called with (name of the stage, done, total).

    Example:
        >>> with open_client() as client:
        ...     reports = ChunkedRun(capture, out, client, config, ChunkConfig(3)).fit()

    Raises:
        ValueError: there are more chunks than pairs of frames.
    """

    def __init__(
        self,
        capture: Capture,
        out: str | Path,
        client: Client,
        config: StreamConfig,
        chunks: ChunkConfig = _ONE_CHUNK,
        on_stage: Report | None = None,
    ) -> None:
        self.capture = capture
        self.out = Path(out)
        self.client = client
        self.progress = Progress(on_stage)
        num_frames = capture.num_frames
        most = max(1, num_frames // _MIN_FRAMES)
        require(
            1 <= chunks.count <= most,
            "ChunkedRun()",
            f"`chunks` must be 1 to {most} for {quantity(num_frames, 'frame')}, {_MIN_FRAMES} for "
            "each",
            chunks.count,
            "choose another number",
        )
        # First frames of chunks of about the same length, and the number of frames.
        starts = np.linspace(0, num_frames, chunks.count + 1)
        self.starts: list[int] = starts.round().astype(int).tolist()
        first_frame = next(capture.partial_frames(0, 1))
        config = with_border(capture, first_frame, config)
        self.task = Fit(recording_of(capture), config, chunks, str(mi.variant()), installed())
        self.metadata = stream_metadata(capture, first_frame, config)
        if chunks.count > 1:
            self.metadata["chunks"] = {"starts": self.starts[:-1], **asdict(chunks)}
        self.recordings: dict[int, Recording] = {}  # by the first frame of the chunk
        self.peaks: dict[str, int] = {}
        self.messages: set[str] = set()

    @interrupts_raised()
    def fit(self, resume: bool = False) -> list[FrameReport]:
        """Fit, or continue, all chunks and join them; return the reports of all frames.

        Args:
            resume: continue the chunks in `out`. The stream has the same bytes as without an
                interruption.

        Raises:
            OSError: as `stream_capture`, a worker died several times, or the scheduler was lost.
                The finished frames stay.
            ValueError: as `stream_capture`.
        """
        check_outputs(self.out)
        with locked_folder(self.out, "ChunkedRun.fit()"):
            folder = self.out / FOLDER
            if resume and not folder.exists():
                earlier = interrupted_fit(FitFiles.of(self.out), self.capture, self.metadata)
                if earlier is not None and len(earlier.reports) == self.capture.num_frames:
                    return earlier.reports
            if not resume:
                _remove(folder)
            folder.mkdir(exist_ok=True)
            with ExitStack() as self.open_files:
                self._fit_side_by_side(self._begun())
            packets = (
                packet
                for start in self.starts[:-1]
                for packet in StreamReader(self._files(start).stream)
            )
            reports = [
                report for start in self.starts[:-1] for report in self.recordings[start].reports
            ]
            with Recording(FitFiles.of(self.out), self.capture, self.metadata) as recording:
                recording.extend(packets, reports, workers=self.peaks)
            _remove(folder)
            return reports

    def _begun(self) -> list[Chunk]:
        """Return the chunks after the common model, which is fitted if it is missing."""
        chunks = []
        for start, stop in pairwise(self.starts):
            chunk = Chunk(start, stop, start)
            earlier = interrupted_fit(self._files(start), self.capture, self.metadata, start)
            if earlier is not None:
                self._open(start, earlier)
                frame = start + len(earlier.reports)
                chunk = replace(chunk, frame=frame, restart=earlier.restart)
            chunks.append(chunk)
        first = chunks[0]
        stop = min(COMMON_FRAMES, first.stop)
        prepared = None
        if not first.frame:
            prepared = Prepared.of(self.capture, self.task.config, self.progress)
            points = (prepared.capture.points, prepared.capture.point_colors)
            self.task = replace(self.task, points=points)
            self._use(prepared.capture)
        else:
            self._use(as_fitted(self.capture, StreamReader(self._files(0).stream)))
        self._show_progress()
        if first.frame < stop:
            part = self._submitted([replace(first, stop=stop)])[0].result()
            if prepared is not None:
                report = prepared.completed(part.reports[0])
                part = replace(part, reports=(report, *part.reports[1:]))
            self.add_part(part)
            first = replace(part.chunk, stop=first.stop)
        self.task = replace(self.task, points=None, balance=self.recordings[0].reports[0].exposures)
        states = StreamReader(self._files(0).stream).states(stop - 1)
        common = next(state for state in states if state.frame == stop - 1)
        restart = (reemitted_keyframe(common).encoded,)
        return [first, *(s if s.restart else replace(s, restart=restart) for s in chunks[1:])]

    def _fit_side_by_side(self, chunks: Iterable[Chunk]) -> None:
        """Fit what is missing of chunks. Each worker continues the loop of one of them, until it
        is fitted.
        """
        from distributed import as_completed

        queue = (chunk for chunk in chunks if chunk.frame < chunk.stop)
        begun = self._submitted(islice(queue, num_workers(self.client)))
        tasks = as_completed(begun, loop=self.client.loop)
        for future in tasks:
            part = future.result()
            self.add_part(part)
            if part.chunk.frame < part.chunk.stop:
                tasks.update(self._submitted([part.chunk], part.worker))
            idle = max(1, num_workers(self.client)) - tasks.count()
            tasks.update(self._submitted(islice(queue, max(0, idle))))

    def _submitted(self, chunks: Iterable[Chunk], worker: str | None = None) -> list[Future[Part]]:
        """Return the tasks of the next frames of chunks, if possible on a worker."""
        chunks = list(chunks)
        stops = [min(chunk.frame + TASK_FRAMES, chunk.stop) for chunk in chunks]
        return self.client.map(
            fit_frames,
            len(chunks) * [self.task],
            chunks,
            stops,
            pure=False,
            workers=worker,
            allow_other_workers=worker is not None,
        )

    def _use(self, capture: Capture) -> None:
        """Fit with the cameras of a capture."""
        if self.task.config.fit.refine_cameras != "off":
            distortions = tuple(view.distortion for view in capture.views)
            self.task = replace(self.task, rig=(capture.cameras, distortions))
            self.capture = capture
            self.metadata |= about_lenses(capture)

    def _files(self, start: int) -> FitFiles:
        """Return stream and report of the chunk that begins with a frame."""
        return FitFiles(self.out / FOLDER / f"{start}.morgs", self.out / FOLDER / f"{start}.json")

    def _open(self, start: int, earlier: Interrupted | None) -> None:
        """Open the files of a chunk."""
        recording = Recording(self._files(start), self.capture, self.metadata, earlier)
        self.recordings[start] = self.open_files.enter_context(recording)

    def add_part(self, part: Part) -> None:
        """Add the frames of a task to the files of their chunk."""
        start = part.chunk.start
        if start not in self.recordings:
            self._open(start, None)
        self.recordings[start].extend(map(decode_packet, part.packets), part.reports)
        self.peaks[part.worker] = part.reports[-1].memory.get("peak", 0)
        for message in {*part.messages} - self.messages:
            _LOG.warning(message)
        self.messages |= {*part.messages}
        self._show_progress()

    def _show_progress(self) -> None:
        num_fitted = sum(len(recording.reports) for recording in self.recordings.values())
        self.progress.of("Fitting frames")(num_fitted, self.capture.num_frames)

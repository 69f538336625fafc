"""The loop on live cameras: whenever it is ready, it fits the newest images; those between are
dropped.

The frames of the stream are numbered in succession, since the loop and its stream know no others;
the report has the time of each. The calibration and the fitted images are a capture like any other:
a stream can be evaluated on it, and its frames fitted again.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame, load_capture
from morgs_mi.capture.layouts.calibration import Calibration
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.layouts.reader_registry import find_reader
from morgs_mi.capture.recorded_view import RecordedView
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.extras.live.cameras import CameraFeed, FrameSet
from morgs_mi.extras.live.live_config import LIVE_STREAM, LiveConfig
from morgs_mi.extras.live.sources import Source, open_feed
from morgs_mi.io.images import ImageOrError
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.extras import extra
from morgs_mi.platform.files import CAPTURE, atomic_path, locked_folder, write_json
from morgs_mi.platform.interrupts import interrupts_raised
from morgs_mi.platform.png import png_bytes
from morgs_mi.platform.progress import Progress, Report, unreported
from morgs_mi.platform.threads import in_background, map_in_threads
from morgs_mi.playback.stream_header import about_lenses
from morgs_mi.runs.fit_capture import Prepared, push_frame, with_border
from morgs_mi.runs.fit_files import (
    FitFiles,
    ProvisionalFrame,
    Recording,
    check_outputs,
    stream_metadata,
)
from morgs_mi.stream_loop import StreamLoop

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class LiveFrame:
    """Report of one frame of a live fit."""

    frame: int  #: Its index in the stream.
    time: float  #: Between the first images and its images, s.
    latency: float  #: Between its images and the end of its fit, s.
    skew: float  #: Largest difference in time between two of its images, s.
    dropped: int  #: Number of images of each camera that were dropped after the frame before.
    problems: tuple[str, ...] = ()  #: One sentence per missing image.


@interrupts_raised()
def fit_live(
    sources: Sequence[Source],
    out: str | Path,
    live: LiveConfig | None = None,
    config: StreamConfig | None = None,
    on_frame: Callable[[LiveFrame, FrameReport], None] = unreported,
    on_stage: Report = unreported,
) -> list[LiveFrame]:
    """Fit live cameras into OUT/stream.morgs until they end, or until Ctrl-C after the first frame.

    OUT/capture has the calibration and the images that were fitted, OUT/report.json the frames with
    their times.

    Args:
        sources: the cameras, see `open_feed`.
        out: folder, made if missing.
        live: settings of the cameras.
        config: settings of the loop; None: `LIVE_STREAM`.
        on_frame: called when a frame is in the stream.
        on_stage: called with (name, done, total) of the work up to the first frame.

    Returns:
        The reports of all frames in the stream.

    Raises:
        FileExistsError: OUT has the capture of an earlier fit.
        FileNotFoundError: the capture with the calibration is missing.
        OSError: a source cannot be opened, or the output cannot be written; the stream ends with a
            complete frame.
        ValueError: a setting is out of range, a video cannot be decoded, a camera has no first
            image, or the cameras cannot be calibrated or do not have the calibrated sizes.
    """
    out = Path(out)
    live = config_or_default("fit_live()", live, LiveConfig(), "live")
    config = config_or_default("fit_live()", config, LIVE_STREAM)
    live.check()
    check_outputs(out)
    folder = out / "capture"
    if folder.exists():
        raise FileExistsError(
            f"{folder}: expected no capture, got that of an earlier fit; choose another "
            "folder for this one."
        )
    calibration = None
    source = live.calibration
    if source is not None:
        if not source.is_dir():
            raise FileNotFoundError(
                f"{source}: expected a calibrated capture of the cameras, found none; check the "
                "path."
            )
        calibration = find_reader(source).read(source)
        if any(view.masks for view in calibration.views):
            _LOG.warning("%s: its masks are not used by a live fit.", source)
        calibration = calibration.without(source, live.without)
    names = calibration and calibration.names
    with locked_folder(out, "fit_live()"), closing(open_feed(sources, live, names)) as feed:
        on_stage("Waiting for the cameras", 0, 1)
        first = feed.newest()
        assert first is not None
        on_stage("Waiting for the cameras", 1, 1)
        capture = begin_capture(folder, first.images, live, calibration, on_stage)
        frames = _LiveFrames(feed, capture, first, live)
        return _fit(frames, out, config, on_frame, on_stage)


def begin_capture(
    folder: Path,
    images: Mapping[str, np.ndarray],
    config: LiveConfig,
    calibration: Calibration | None = None,
    on_stage: Report | None = None,
) -> Capture:
    """Write the first images and the calibration of live cameras, and return the capture, which has
    one frame.

    Args:
        folder: is made, and must not exist.
        images: one per camera, by its name, uint8 [H, W, 3], RGB.
        config: settings.
        calibration: of the cameras; None: they are calibrated by the images.
        on_stage: called with (name, done, total) of the calibration.

    Raises:
        OSError: the disk is full or not writable.
        ValueError: the cameras cannot be calibrated, or the images do not have the calibrated
            sizes.
    """
    try:
        write_images(folder, images, 0)
        write_json(folder / CAPTURE, {"fps": config.fps})
        if calibration is not None:
            write_colmap(
                folder / "sparse" / "0",
                calibration.views,
                calibration.points,
                calibration.point_colors,
            )
        else:
            calibrate = extra("cameras", "calibrate")
            try:
                calibrate(folder, progress=on_stage)
            except ValueError as error:
                error.add_note(
                    f"The images are in {folder}: calibrate them with morgs-mi calibrate, which "
                    "has more options, and pass that folder with --calibration."
                )
                raise
        # A camera may stop: later frames are read without its images.
        return load_capture(
            folder, config.downscale, config.test_view or None, reading=ReadConfig(gaps=True)
        )
    except (OSError, ValueError) as error:
        # The fit can be started again; images that cannot be calibrated stay.
        if calibration is not None or isinstance(error, OSError):
            shutil.rmtree(folder, ignore_errors=True)
        raise


def write_images(folder: Path, images: Mapping[str, np.ndarray], frame: int) -> None:
    """Write the images of a frame into a capture, by the names of the cameras, side by side.

    Raises:
        OSError: the disk is full or not writable.
    """

    def write(name: str) -> None:
        file = folder / name / f"{frame:04d}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(file, "fit_live()") as partial:
            partial.write_bytes(png_bytes(images[name]))

    map_in_threads(write, [*images])


@dataclass
class _LiveFrames:
    """Frames of a live capture, processed like the frames of any capture."""

    feed: CameraFeed  # cameras
    capture: Capture  # capture of their first images
    first: FrameSet  # these images
    config: LiveConfig

    def __iter__(self) -> Iterator[tuple[FrameSet, PartialFrame]]:
        """Yield whenever the next frame is asked for the newest images, as recorded and as
        processed.
        """
        frame_set = self.first
        frame = None
        for index in count():
            images = map_in_threads(partial(self._processed, frame_set), self.capture.views)
            frame = PartialFrame.of(index, self.capture.views, images, frame)
            yield frame_set, frame
            if index + 1 == self.config.frames:
                return
            if (frame_set := self.feed.newest(frame_set)) is None:
                _LOG.warning("the fit ends after frame %d: %s", index, self.feed.ended())
                return

    def _processed(self, frame_set: FrameSet, view: RecordedView) -> ImageOrError:
        """Return the processed image of a view, or an error if it has none of its size."""
        image = frame_set.images.get(view.name)
        if image is None:
            return ValueError(self.feed.problem(view.name).rstrip("."))
        if (size := image.shape[1::-1]) != view.recorded_size:
            sizes = (*view.recorded_size, *size)
            return ValueError("expected an image of {}x{}, got {}x{}".format(*sizes))
        return view.process(image)


def _fit(
    frames: _LiveFrames,
    out: Path,
    config: StreamConfig,
    on_frame: Callable[[LiveFrame, FrameReport], None],
    on_stage: Report,
) -> list[LiveFrame]:
    """Fit live frames into a locked folder."""
    capture = frames.capture
    first_frame = next(capture.partial_frames())
    config = with_border(capture, first_frame, config)
    metadata = stream_metadata(capture, first_frame, config)
    del metadata["num_frames"]  # not known yet
    prepared = Prepared.of(capture, config, Progress(on_stage))
    frames.capture = prepared.capture
    loop = StreamLoop.of(prepared.capture, config)
    rows: list[LiveFrame] = []
    metadata |= about_lenses(prepared.capture)
    files = FitFiles.of(out)
    provisional = ProvisionalFrame(files.provisional, prepared.capture, metadata)
    with Recording(files, prepared.capture, metadata) as recording:
        try:
            for frame_set, frame in frames:
                writing_task = in_background(partial(_record, frames, out, frame_set, frame))
                packet, report = push_frame(
                    loop, frame, None if rows else on_stage, None, provisional.show
                )
                report = prepared.completed(report)
                writing_task.result()
                row = LiveFrame(
                    frame.index,
                    frame_set.time - frames.first.time,
                    time.monotonic() - frame_set.time,
                    frame_set.skew,
                    frame_set.dropped,
                    frame.problems,
                )
                live = [asdict(r) for r in (*rows, row)]
                recording.push(packet, report, loop.state.coded, live=live)
                rows.append(row)
                on_frame(row, report)
        except KeyboardInterrupt:
            if not rows:
                raise
        except OSError as error:
            if rows:
                error.add_note(f"{out / 'stream.morgs'} ends with frame {rows[-1].frame}.")
            raise
    return rows


def _record(frames: _LiveFrames, out: Path, frame_set: FrameSet, frame: PartialFrame) -> None:
    """Write the recorded images of a frame into the capture, which has the first frame's."""
    if frames.config.record and frame.index:
        recorded = frame_set.images
        images = {view.name: recorded[view.name] for view in frame.views if view.has_image}
        write_images(out / "capture", images, frame.index)

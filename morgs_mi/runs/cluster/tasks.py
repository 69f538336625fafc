"""The task of the workers: fit a few frames of a chunk.

A task gets the state as packets, reads the recording from a path that the worker sees, and returns
packets. It writes no files and can be repeated anywhere. A worker keeps the loop of its last task:
where the next one continues it, nothing is read twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame, load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.codec.container import Packet, decode_packet
from morgs_mi.codec.packets import CodedFrame, decode, reemitted_keyframe
from morgs_mi.core.camera import Camera
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.exposure import Exposure
from morgs_mi.runs.cluster.boundaries import ChunkConfig, fit_boundary_frame
from morgs_mi.runs.cluster.workers import prepared, worker_name
from morgs_mi.runs.fit_capture import push_frame, with_next
from morgs_mi.runs.fit_files import due_keyframe, restart_of
from morgs_mi.stream_loop import StreamLoop


@dataclass(frozen=True)
class Source:
    """A capture as every worker opens it; the other fields are as `load_capture` takes them."""

    path: str  #: Its folder, absolute.
    downscale: float
    test_views: tuple[int, ...]
    num_frames: int
    reading: ReadConfig

    @classmethod
    def of(cls, capture: Capture) -> Source:
        """Return the source of an open capture."""
        path = str(capture.path.resolve())
        return cls(path, capture.downscale, capture.test_views, capture.num_frames, capture.reading)

    def open(self) -> Capture:
        """Return the capture."""
        return load_capture(
            self.path, self.downscale, self.test_views, self.num_frames, self.reading
        )


@dataclass(frozen=True)
class Fit:
    """Data that all tasks of a fit share."""

    source: Source  #: The recording.
    config: StreamConfig  #: Settings.
    chunks: ChunkConfig  #: The chunks, and the settings of their boundaries.
    variant: str  #: Mitsuba variant.
    versions: tuple[tuple[str, str], ...]  #: As `installed` returns them to the client.
    #: Refined cameras and distortions, as `Capture.with_cameras` takes them; None: the recording's.
    rig: tuple[tuple[Camera, ...], tuple[tuple[float, float], ...]] | None = None
    #: Points and their colours in place of the capture's, where those have been triangulated.
    points: tuple[np.ndarray, np.ndarray] | None = None
    #: Exposures in the first frame of the recording, by view; empty before it is fitted.
    balance: tuple[Exposure, ...] = ()

    def open(self) -> Capture:
        """Return the recording, with the refined cameras and the triangulated points."""
        capture = self.source.open()
        if self.rig is not None:
            capture = capture.with_cameras(*self.rig)
        if self.points is not None:
            capture = replace(capture, points=self.points[0], point_colors=self.points[1])
        return capture


@dataclass(frozen=True)
class Chunk:
    """A part of a recording, from frame `start` up to `stop`, and how far it is fitted."""

    start: int
    stop: int
    frame: int  #: The next one to fit.
    #: Encoded packets that lead a decoder to the state before that frame, a keyframe and perhaps a
    #: residual. Before a chunk begins, they lead to the common model; before the recording
    #: begins, there are none.
    restart: tuple[bytes, ...] = ()

    @property
    def coded(self) -> CodedFrame | None:
        """State before the next frame."""
        coded = None
        for data in self.restart:
            coded = decode(coded, decode_packet(data))
        return coded


@dataclass(frozen=True)
class Part:
    """Result of a task."""

    chunk: Chunk  #: The chunk after its frames.
    packets: tuple[bytes, ...]  #: Encoded packets of the frames, re-emitted keyframes included.
    reports: tuple[FrameReport, ...]  #: Of the frames.
    worker: str  #: Address of the worker.
    messages: tuple[str, ...]  #: Warnings.


# The loop of the last task by what continues it, with the capture and its next frames.
_OPEN: dict[tuple[str, Chunk], tuple[StreamLoop, Capture, Iterator[PartialFrame]]] = {}


def fit_frames(fit: Fit, chunk: Chunk, stop: int) -> Part:
    """Fit the next frames of a chunk, up to `stop`, one after the other."""
    with prepared(fit.variant, fit.versions) as messages:
        packets = list[Packet]()
        reports = list[FrameReport]()
        if 0 < chunk.start == chunk.frame:
            keyframe, report = _first_frame(fit, chunk)
            packets.append(keyframe)
            reports.append(report)
            chunk = replace(chunk, frame=chunk.start + 1, restart=(keyframe.encoded,))
        last = _OPEN.pop((repr(fit), chunk), None)
        _OPEN.clear()
        if last is not None:
            loop, capture, recorded = last
        else:
            capture = fit.open()
            loop = StreamLoop.of(capture, fit.config)
            recorded = capture.partial_frames(chunk.start)
            coded = chunk.coded
            if coded is not None:
                # Exposures are relative to the first frame of the recording.
                first = _images(capture, 0, 1) if chunk.start else []
                frames = islice(recorded, chunk.frame - chunk.start)
                past = (past_frame.comparable(capture.train_views) for past_frame in frames)
                loop.resume(coded, chain(first, past), fit.balance)
        restart = chunk.restart
        for frame, upcoming in with_next(islice(recorded, stop - chunk.frame)):
            last_state = loop.state.coded
            packet, report = push_frame(loop, frame, capture.train_views, None, upcoming)
            packets += [packet, *due_keyframe(loop.state.coded, fit.config.codec.keyframe_interval)]
            reports.append(report)
            restart = restart_of(last_state, packet)
        chunk = replace(chunk, frame=stop, restart=restart)
        _OPEN[repr(fit), chunk] = loop, capture, recorded
        contents = tuple(packet.encoded for packet in packets)
        return Part(chunk, contents, tuple(reports), worker_name(), tuple(messages))


def _first_frame(fit: Fit, chunk: Chunk) -> tuple[Packet, FrameReport]:
    """Fit the frames before a chunk that follow the common model, and its first one; return its
    keyframe.
    """
    capture = fit.open()
    common = chunk.coded
    assert common is not None
    loop = StreamLoop.of(capture, fit.chunks.overlap_config(fit.config))
    frame = max(chunk.start - fit.chunks.overlap, common.frame + 1)
    loop.resume(common, _images(capture, 0, common.frame + 1), fit.balance)
    (images,) = _images(capture, frame, frame + 1)
    coded, report = fit_boundary_frame(loop.setup, loop.state, frame, images, fit.chunks)
    loop.resume(coded, [*_images(capture, 0, 1), images], fit.balance)
    seconds = report.seconds
    for recorded, upcoming in with_next(capture.partial_frames(frame + 1, chunk.start + 1)):
        _, report = push_frame(loop, recorded, capture.train_views, None, upcoming)
        seconds += report.seconds
    assert loop.state.coded is not None
    keyframe = reemitted_keyframe(loop.state.coded)
    return keyframe, replace(report, seconds=seconds, num_bytes=keyframe.num_bytes)


def _images(capture: Capture, start: int, stop: int) -> list[list[np.ndarray | None]]:
    """Return the images of some frames, of the training views."""
    return [frame.comparable(capture.train_views) for frame in capture.partial_frames(start, stop)]

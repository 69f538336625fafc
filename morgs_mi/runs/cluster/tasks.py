"""Tasks of the workers: fit a few frames of a segment, or the first frame of one.

A task gets the state as packets, reads the recording from a path that the worker sees, and returns packets. It writes
no files and can be repeated anywhere. A worker keeps the loop of its last task: where the next one continues
it, nothing is read twice.
"""

from __future__ import annotations

import logging
import os
import platform
import resource
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame, load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.codec.container import Packet, decode_packet
from morgs_mi.codec.packets import CodedFrame, coded_frames, decode, reemitted_keyframe
from morgs_mi.core.camera import Camera
from morgs_mi.core.environment import versions
from morgs_mi.io.remote import url_of
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.exposure import Exposure
from morgs_mi.runs.cluster.executor import share_of_machine
from morgs_mi.runs.cluster.seams import Moment, Overlap, SegmentConfig, cross_fade, fit_seam_frame
from morgs_mi.runs.recorder import push_frame, with_next
from morgs_mi.runs.recording import due_keyframe, restart_of
from morgs_mi.stream_loop import FrameReport, StreamLoop

__all__ = [
    "Fit",
    "Following",
    "FrameRange",
    "Part",
    "Source",
    "fit_frames",
    "fit_segment_start",
    "installed",
    "prepared",
]


@dataclass(frozen=True)
class Source:
    """A capture as every worker opens it.

    Attributes:
        path: its folder, absolute, or its URL.
        downscale, test_views, num_frames, reading: as `load_capture` takes them.
    """

    path: str
    downscale: float
    test_views: tuple[int, ...]
    num_frames: int
    reading: ReadConfig

    @classmethod
    def of(cls, capture: Capture) -> Source:
        """Return the source of an open capture."""
        path = url_of(capture.path) or str(capture.path.resolve())
        return cls(path, capture.downscale, capture.test_views, capture.num_frames, capture.reading)

    def open(self) -> Capture:
        """Return the capture."""
        return load_capture(self.path, self.downscale, self.test_views, self.num_frames, self.reading)


Points = tuple[np.ndarray, np.ndarray]
Rig = tuple[tuple[Camera, ...], tuple[tuple[float, float], ...]]


@dataclass(frozen=True)
class Fit:
    """Data that all tasks of a fit share.

    Attributes:
        source: the recording.
        config: settings.
        segments: the segments, and the settings of their seams.
        variant: Mitsuba variant.
        versions: as `installed` returns them to the client.
        rig: refined cameras and distortions, as `Capture.with_cameras` takes them; None: the recording's.
        balance: exposures in the first frame of the recording, by view; empty before it is fitted.
    """

    source: Source
    config: StreamConfig
    segments: SegmentConfig
    variant: str
    versions: tuple[tuple[str, str], ...]
    rig: Rig | None = None
    balance: tuple[Exposure, ...] = ()

    def open(self) -> Capture:
        """Return the recording, with the refined cameras."""
        capture = self.source.open()
        return capture if self.rig is None else capture.with_cameras(*self.rig)


@dataclass(frozen=True)
class FrameRange:
    """Frames of a task.

    Attributes:
        segment: first frame of their segment.
        start, stop: the frames.
    """

    segment: int
    start: int
    stop: int


@dataclass(frozen=True)
class Following:
    """The next segment, to which the last frames of a segment fade.

    Attributes:
        packets: encoded packets of its frames before its first one, the overlap.
        shared_ids: number of ids of the common model.
    """

    packets: tuple[bytes, ...]
    shared_ids: int


@dataclass(frozen=True)
class Part:
    """Result of a task.

    Attributes:
        packets: encoded packets of the frames, re-emitted keyframes included.
        reports: of the frames.
        restart: packets that lead a decoder to the state after the last frame: that frame's keyframe, or a keyframe of
            the frame before and its residual.
        worker: name of the worker.
        peak_bytes: peak memory of the worker so far.
        messages: warnings.
    """

    packets: tuple[bytes, ...]
    reports: tuple[FrameReport, ...]
    restart: tuple[bytes, ...]
    worker: str
    peak_bytes: int
    messages: tuple[str, ...]


_BUSY = threading.Lock()  # Dask runs several tasks at once in a worker with several threads
_OPEN: dict[tuple[Any, ...], tuple[StreamLoop, Capture, Iterator[PartialFrame]]] = {}  # the loop of the last task


def fit_frames(
    fit: Fit,
    frames: FrameRange,
    restart: tuple[bytes, ...],
    following: Following | None = None,
    points: Points | None = None,
) -> Part:
    """Fit frames of a segment, one after the other.

    Args:
        fit: what all tasks of the fit share.
        frames: the frames.
        restart: state before them, as in `Part`; empty before the first frame of the recording.
        following: the next segment, if these frames are the last ones of their segment and fade to it.
        points: points and their colours in place of the capture's, where those have been triangulated.
    """
    with prepared(fit.variant, fit.versions) as messages:
        loop, capture, recorded = _opened(fit, frames, restart, points)
        start = before = loop.state.coded
        packets, states, reports = list[Packet](), list[CodedFrame](), list[FrameReport]()
        for frame, upcoming in with_next(islice(recorded, frames.stop - frames.start)):
            before = loop.state.coded
            packet, report = push_frame(loop, frame, capture.train_views, _check_memory, upcoming)
            assert loop.state.coded is not None
            packets.append(packet)
            states.append(loop.state.coded)
            reports.append(report)
        restart = restart_of(before, packets[-1])
        if following is None:
            _OPEN[_key(fit, frames.segment, frames.stop, restart)] = loop, capture, recorded
        else:
            assert start is not None
            packets, states = _faded(start, states, following, loop.setup.cameras, fit)
            sizes = zip(reports, packets, states, strict=True)
            reports = [replace(r, num_bytes=p.num_bytes, num_gaussians=len(s)) for r, p, s in sizes]
        interval = fit.config.codec.keyframe_interval
        stored = [q for p, s in zip(packets, states, strict=True) for q in (p, *due_keyframe(s, interval))]
        return _part(stored, reports, restart, messages)


def fit_segment_start(fit: Fit, base: bytes, frame: int) -> Part:
    """Fit the overlap before a segment, and its first frame.

    Args:
        fit: what all tasks of the fit share.
        base: a keyframe of the common model, as an encoded packet.
        frame: first frame of the segment.

    Returns:
        The packets of the overlap and of the frame, which ends with a keyframe, and the report of the frame.
    """
    with prepared(fit.variant, fit.versions) as messages:
        capture, coded = fit.open(), decode(None, decode_packet(base))
        loop = StreamLoop.of(capture, fit.segments.overlap_config(fit.config))
        first = max(frame - fit.segments.overlap, coded.frame + 1)
        loop.resume(coded, _images(capture, 0, coded.frame + 1), fit.balance)
        now = Moment(first, *_images(capture, first, first + 1))
        coded, report = fit_seam_frame(loop.setup, loop.state, now, fit.segments, _check_memory)
        loop.resume(coded, [*_images(capture, 0, 1), now.images], fit.balance)
        before, packets, seconds = None, [reemitted_keyframe(coded)], report.seconds
        for recorded, upcoming in with_next(capture.partial_frames(first + 1, frame + 1)):
            before = loop.state.coded
            packet, report = push_frame(loop, recorded, capture.train_views, _check_memory, upcoming)
            packets.append(packet)
            seconds += report.seconds
        restart = restart_of(before, packets[-1])
        if before is not None:
            assert loop.state.coded is not None
            packets.append(reemitted_keyframe(loop.state.coded))
        report = replace(report, seconds=seconds, num_bytes=packets[-1].num_bytes)
        return _part(packets, [report], restart, messages)


def installed() -> tuple[tuple[str, str], ...]:
    """Return the versions that must be the same in client and workers."""
    python = ".".join(platform.python_version_tuple()[:2])
    return tuple(({**versions(), "python": python}).items())


def _part(packets: list[Packet], reports: list[FrameReport], restart: tuple[bytes, ...], messages: list[str]) -> Part:
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    worker = f"{socket.gethostname()}:{os.getpid()}"
    return Part(tuple(p.encoded for p in packets), tuple(reports), restart, worker, peak, tuple(messages))


@contextmanager
def prepared(variant: str, versions: tuple[tuple[str, str], ...]) -> Iterator[list[str]]:
    """Run a task alone in this process, with its variant and threads; the context is a list of its warnings.

    Args:
        variant: Mitsuba variant of the client.
        versions: as `installed` returned them to the client.

    Raises:
        ValueError: the worker has other versions than the client.
    """
    for (name, expected), (_, found) in zip(versions, installed(), strict=True):
        if expected != found:
            raise ValueError(
                f"{socket.gethostname()}: expected a worker with {name} {expected} like the client, got {found}; "
                "install the same versions on both."
            )
    messages: list[str] = []
    with _BUSY, _logged(messages):
        if mi.variant() != variant:
            mi.set_variant(variant)
        threads, _ = share_of_machine()
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)
            cv2.setNumThreads(threads)
        yield messages


@contextmanager
def _logged(messages: list[str]) -> Iterator[None]:
    """Collect the warnings of the package."""
    handler, log = logging.Handler(logging.WARNING), logging.getLogger("morgs_mi")
    handler.emit = lambda record: messages.append(record.getMessage())
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)


def _check_memory(stage: str, done: float, total: float) -> None:
    """Raise an error if this process has more memory than its share; called after every step.

    Raises:
        MemoryError: it has.
    """
    _, limit = share_of_machine()
    with suppress(OSError):
        with open("/proc/self/statm", encoding="ascii") as file:
            used = int(file.read().split()[1]) * resource.getpagesize()
        if limit and used > limit:
            raise MemoryError(
                f"{socket.gethostname()}: expected a worker with at most {limit / 1e9:.1f} GB, its share, got "
                f"{used / 1e9:.1f} GB; use fewer workers, or process smaller images."
            )


def _opened(
    fit: Fit, frames: FrameRange, restart: tuple[bytes, ...], points: Points | None
) -> tuple[StreamLoop, Capture, Iterator[PartialFrame]]:
    """Return a loop before the first of some frames, with the capture and its frames from there on."""
    found = _OPEN.pop(_key(fit, frames.segment, frames.start, restart), None)
    _OPEN.clear()
    if found is not None:
        return found
    capture = fit.open()
    if points is not None:
        capture = replace(capture, points=points[0], point_colors=points[1])
    loop, recorded = StreamLoop.of(capture, fit.config), capture.partial_frames(frames.segment)
    if restart:
        # Exposures are relative to the first frame of the recording.
        first = _images(capture, 0, 1) if frames.segment else []
        past = (frame.comparable(capture.train_views) for frame in islice(recorded, frames.start - frames.segment))
        loop.resume(_decoded(restart), chain(first, past), fit.balance)
    return loop, capture, recorded


def _key(fit: Fit, segment: int, start: int, restart: tuple[bytes, ...]) -> tuple[Any, ...]:
    return (repr(fit), segment, start, restart)


def _decoded(packets: tuple[bytes, ...]) -> CodedFrame:
    coded = None
    for data in packets:
        coded = decode(coded, decode_packet(data))
    assert coded is not None
    return coded


def _images(capture: Capture, start: int, stop: int) -> list[list[np.ndarray | None]]:
    """Return the images of some frames, of the training views."""
    return [frame.comparable(capture.train_views) for frame in capture.partial_frames(start, stop)]


def _faded(
    before: CodedFrame, states: Sequence[CodedFrame], following: Following, cameras: Sequence[Camera], fit: Fit
) -> tuple[list[Packet], list[CodedFrame]]:
    """Return packets and states of the last frames of a segment in the cross-fade to the next one."""
    frames = {state.frame for state in states}
    beginning = [coded for coded in coded_frames(map(decode_packet, following.packets)) if coded.frame in frames]
    overlap = Overlap(states, beginning, following.shared_ids)
    packets, faded = zip(*cross_fade(before, overlap, cameras, fit.config.codec), strict=True)
    return list(packets), list(faded)

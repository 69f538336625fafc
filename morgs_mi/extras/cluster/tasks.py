"""The task of the workers: fit a few frames of a chunk.

All chunks start from one common model, the first two frames of the recording. A chunk is fitted
from some frames before its first one (*overlap*). The first of these is fitted like a later frame
of the common model, several times over, until Gaussians that have travelled far since then arrive;
the others follow as usual. What has not changed since the first frames stays as it is, to the bit.

A task gets the state as packets, reads the recording from a path that the worker sees, and returns
packets. It writes no files and can be repeated anywhere. A worker keeps the loop of its last task:
where the next one continues it, nothing is read twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, islice

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame, load_capture
from morgs_mi.capture.fingerprint import image_fingerprints
from morgs_mi.codec.container import Packet, decode_packet
from morgs_mi.codec.packets import CodedFrame, decode, reemitted_keyframe
from morgs_mi.core.camera import Camera
from morgs_mi.core.view import View, Views
from morgs_mi.extras.cluster.workers import prepared, worker_name
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.input_images import FrameImages
from morgs_mi.loop.observation import Setup
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.exposure import Exposure
from morgs_mi.platform.config import Count, NonNegativeInt, config_class
from morgs_mi.runs.fit_capture import push_frame, with_next
from morgs_mi.runs.fit_files import due_keyframe, restart_of
from morgs_mi.stream_loop import StreamLoop, StreamState, step

COMMON_FRAMES = 2
"""Frames of the common model: the second one determines the confidence."""

# Factor on the learning rates of the fits of the first frame: there is further to go than between
# two frames.
_RATES = 2.0
# Largest number of births in each of them, as a fraction of the Gaussians.
_BIRTHS = 0.1
# Factor on the epochs of the other frames: the fit is not yet as good as one that followed from the
# beginning.
_OVERLAP_EPOCHS = 2
# The loop of the last task by what continues it, with the capture and its next frames.
_OPEN: dict[tuple[str, Chunk], tuple[StreamLoop, Capture, Iterator[PartialFrame]]] = {}


@config_class
class ChunkConfig:
    """Chunks of a fit, and the boundaries between them."""

    count: int = 1
    """Number of chunks of about the same length, of two frames at least; with one, the stream
    equals `stream_capture`'s."""
    passes: Count = 24
    """Fits of the first frame of the overlap, one after the other, each with a round of density
    control.
    """
    epochs: Count = 4
    """Passes over all training views in each of them."""
    overlap: NonNegativeInt = 10
    """Frames before a chunk that are fitted as well: its Gaussians then follow the recording from
    its first frame.
    """

    def fit_config(self, config: StreamConfig, number: int) -> StreamConfig:
        """Return the settings of one of these fits."""
        rates = {name: _RATES * rate for name, rate in asdict(config.fit.rates).items()}
        fit = replace(
            config.fit,
            epochs=self.epochs,
            rates=replace(config.fit.rates, **rates),
            density=replace(config.fit.density, births=_BIRTHS),
        )
        return replace(config, fit=fit, seed=config.seed + number)


def recording_of(capture: Capture) -> Callable[[], Capture]:
    """Return the function with which every worker opens a capture, at its absolute path."""
    settings = (capture.downscale, capture.test_views, capture.num_frames, capture.reading)
    return partial(load_capture, str(capture.path.resolve()), *settings)


@dataclass(frozen=True)
class Fit:
    """Data that all tasks of a fit share."""

    recording: Callable[[], Capture]  #: From `recording_of`.
    config: StreamConfig  #: Settings.
    chunks: ChunkConfig  #: The chunks, and the settings of their boundaries.
    variant: str  #: Mitsuba variant.
    versions: tuple[tuple[str, str], ...]  #: As `installed` returns them to the client.
    #: Refined cameras and distortions, as `Capture.with_cameras` takes them; None: the recording's.
    rig: tuple[tuple[Camera, ...], tuple[tuple[float, float], ...]] | None = None
    #: Points and their colours of the first frame, triangulated where the capture has few; None
    #: after it.
    points: tuple[np.ndarray, np.ndarray] | None = None
    #: Exposures in the first frame of the recording, by view; empty before it is fitted.
    balance: tuple[Exposure, ...] = ()

    def open(self) -> Capture:
        """Return the recording, with the refined cameras and the triangulated points."""
        capture = self.recording()
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
                past = (past_frame.comparable for past_frame in frames)
                loop.resume(coded, chain(first, past), fit.balance)
        restart = chunk.restart
        for frame, upcoming in with_next(islice(recorded, stop - chunk.frame)):
            last_state = loop.state.coded
            packet, report = push_frame(loop, frame, None, upcoming)
            packets += [packet, *due_keyframe(loop.state.coded, fit.config.codec.keyframe_interval)]
            reports.append(replace(report, fingerprints=image_fingerprints(frame.images)))
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
    longer_fit = replace(fit.config.fit, epochs=_OVERLAP_EPOCHS * fit.config.fit.epochs)
    loop = StreamLoop.of(capture, replace(fit.config, fit=longer_fit))
    frame = max(chunk.start - fit.chunks.overlap, common.frame + 1)
    loop.resume(common, _images(capture, 0, common.frame + 1), fit.balance)
    (images,) = _images(capture, frame, frame + 1)
    coded, report = fit_boundary_frame(loop.setup, loop.state, frame, images, fit.chunks)
    loop.resume(coded, [*_images(capture, 0, 1), images], fit.balance)
    seconds = report.seconds
    for recorded, upcoming in with_next(capture.partial_frames(frame + 1, chunk.start + 1)):
        _, report = push_frame(loop, recorded, None, upcoming)
        seconds += report.seconds
    assert loop.state.coded is not None
    keyframe = reemitted_keyframe(loop.state.coded)
    return keyframe, replace(report, seconds=seconds, num_bytes=keyframe.num_bytes)


def _images(capture: Capture, start: int, stop: int) -> list[Views[View]]:
    """Return the training views of some frames, with their images."""
    return [frame.comparable for frame in capture.partial_frames(start, stop)]


def fit_boundary_frame(
    setup: Setup,
    common: StreamState,
    frame: int,
    images: FrameImages,
    config: ChunkConfig,
) -> tuple[CodedFrame, FrameReport]:
    """Fit a frame far from the common model, and return its state and its report.

    Args:
        setup: what all frames share.
        common: the common model, after its last frame.
        frame: the frame.
        images: its images.
        config: settings.
    """
    # Motion over many frames is no speed.
    views = Views(replace(view, camera=view.camera.without_delays()) for view in setup.views)
    setup = replace(setup, views=views)
    coded = common.coded
    assert coded is not None
    history = common.history
    seconds = 0.0
    for number in range(config.passes):
        pass_setup = replace(setup, config=config.fit_config(setup.config, number))
        state = replace(common, frame=frame, coded=replace(coded, frame=frame - 1), history=history)
        state, _, report = step(pass_setup, state, images)
        coded = state.coded
        assert coded is not None
        # Changes are relative to the common model again.
        views = {
            v: replace(common.history.views.get(v, view), image=view.image)
            for v, view in state.history.views.items()
        }
        history = replace(common.history, views=views)
        seconds += report.seconds
    return coded, replace(report, seconds=seconds)

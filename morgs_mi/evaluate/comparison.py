"""A stream beside its recording: clip, frames and views, as the measures compare them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.capture.truth import GroundTruth
from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.frame_source import FrameSource, FrameState
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import display_image, exposed
from morgs_mi.core.rig import scene_planes
from morgs_mi.core.types import Arrays
from morgs_mi.evaluate.metrics import recorded_change
from morgs_mi.playback.player import has_confidence, render
from morgs_mi.playback.stream_header import open_stream_capture, render_config, truth_for_camera
from morgs_mi.playback.visualise import to_uint8
from morgs_mi.render.render_config import RenderConfig


@dataclass(frozen=True, eq=False)
class ComparedClip:
    """A stream and its recording."""

    stream: FrameSource  #: The stream.
    recording: Capture  #: Its capture.
    packets: Mapping[int, tuple[PacketKind, int]]  #: Kind and size of each frame's packet.
    #: The evaluated views: the held-out ones, or otherwise all training views.
    views: Sequence[int]
    #: Of each held-out view, the training view at the least angle from it, as seen from the scene.
    nearest: Mapping[int, int]
    cameras: Sequence[Camera]  #: Of all views, with the delays of the recording.
    channels: Sequence[str]  #: Rendered channels.
    render: RenderConfig  #: Settings of the renderer, as in the fit.

    @classmethod
    def of(
        cls, stream: FrameSource, capture: str | Path | None, any_recording: bool = False
    ) -> ComparedClip:
        """Return a stream beside `capture`; None: the capture that it was fitted to.

        The sizes are read from the file and not from the fit's report, because a receiver has only
        the file. The capture must be the recording that was fitted, unless it may be any.

        Raises:
            FileNotFoundError: the capture is missing.
            ValueError: the stream is truncated, broken or empty, or was fitted to another capture.
        """
        packets = dict[int, tuple[PacketKind, int]]()
        for packet in stream:
            # Later packets of a frame are re-emitted keyframes.
            packets.setdefault(packet.frame, (packet.kind, packet.num_bytes))
        recording = open_stream_capture(stream, capture, list(packets), any_recording)
        views = recording.test_views or recording.train_views
        channels = ("color", "motion")
        if has_confidence(stream):
            channels = (*channels, "confidence")
        cameras = recording.with_delays(stream.cameras)
        return cls(
            stream,
            recording,
            packets,
            views,
            nearest_views(recording, cameras),
            cameras,
            channels,
            render_config(stream),
        )

    def frames(self) -> Iterator[ComparedFrame]:
        """Yield the decoded frames beside the recorded ones."""
        last: dict[int, np.ndarray] = {}
        stops = self.recording.display_exposure or 0.0
        # The file may have grown since it was read.
        states = islice(self.stream.states(), len(self.packets))
        recorded = self.recording.partial_frames(min(self.packets), max(self.packets) + 1)
        for state, frame in zip(states, recorded, strict=True):
            kind, num_bytes = self.packets[state.frame]
            images = {
                index: RecordedImage(display_image(view.image, stops), last.get(index), view.image)
                for index, view in enumerate(frame.views)
                if view.has_image
            }
            yield ComparedFrame(self, state, kind, num_bytes, frame, images)
            last = {index: recorded.image for index, recorded in images.items()}


def nearest_views(recording: Capture, cameras: Sequence[Camera]) -> dict[int, int]:
    """Return, of each held-out view, the training view at the least angle from it, as seen from the
    scene.
    """
    planes = scene_planes(cameras, recording.points)
    train_cameras = [cameras[view] for view in recording.train_views]
    angles = {view: planes[view].angles_to(train_cameras) for view in recording.test_views}
    return {view: recording.train_views[values.argmin()] for view, values in angles.items()}


@dataclass(frozen=True, eq=False)
class RecordedImage:
    """Recorded image of a view in one frame."""

    image: np.ndarray  #: [H, W, 3], as a display shows it.
    last: np.ndarray | None  #: Likewise of the frame before; None: there is none.
    light: np.ndarray  #: The image as it was recorded.


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """A decoded frame and the recorded one."""

    clip: ComparedClip  #: Their clip.
    state: FrameState  #: Its Gaussians.
    kind: PacketKind  #: Kind of the frame's packet.
    num_bytes: int  #: Its size.
    recorded: PartialFrame  #: The recorded frame.
    images: Mapping[int, RecordedImage]  #: Its images by view index, without missing ones.

    def views(self) -> Iterator[ComparedView]:
        """Render and yield the evaluated views, except those without an image."""
        clip = self.clip
        for index in clip.views:
            camera = clip.cameras[index]
            recorded = self.images.get(index)
            if recorded is not None:
                maps = render(self.state.gaussians, camera, clip.channels, clip.render)
                truth = truth_for_camera(clip.recording, camera, self.state.frame)
                moving = None if truth is None else truth.mask
                if recorded.last is not None and clip.recording.truth is None:
                    moving = recorded_change(recorded.last, recorded.image)
                nearest = clip.nearest.get(index)
                near_image = None if nearest is None else self.images.get(nearest)
                copy = None if near_image is None else near_image.image
                light = None if clip.recording.display_exposure is None else recorded.light
                valid = clip.recording.masks[index]
                image = recorded.image
                yield ComparedView(self, index, maps, image, valid, moving, truth, light, copy)


@dataclass(frozen=True, eq=False)
class ComparedView:
    """One view of a frame, rendered and recorded."""

    frame: ComparedFrame  #: Its frame.
    index: int  #: Of the view.
    maps: Arrays  #: Rendered channels by name.
    recorded: np.ndarray  #: image [H, W, 3], uint8; of an HDR recording as a display shows it.
    valid: np.ndarray | None  #: Valid pixels [H, W] bool; None: all.
    moving: np.ndarray | None  #: Moving pixels [H, W] bool; None: unknown.
    truth: GroundTruth | None  #: Ground truth; None: unknown.
    light: np.ndarray | None = None  #: Image of an HDR recording [H, W, 3], linear; None of others.
    #: Of a held-out view, the recorded image of the nearest training view [H', W', 3], uint8.
    nearest: np.ndarray | None = None

    @property
    def camera(self) -> Camera:
        """Camera of the view, with its delay."""
        return self.frame.clip.cameras[self.index]

    @property
    def rendered(self) -> np.ndarray:
        """Rendered image [H, W, 3], uint8 as a decoder shows it."""
        return to_uint8(
            exposed(self.maps["color"], self.frame.clip.recording.display_exposure or 0.0)
        )

"""A multi-view recording: pinhole cameras and their synchronised frames.

`layouts/reader_registry.py` finds the reader of a capture folder, `layouts/clips.py` finds
each camera's clip. An optional ``capture.json`` has settings (see `capture_settings`);
``truth/`` may hold ground truth.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from morgs_mi.capture.capture_settings import read_settings
from morgs_mi.capture.held_out import TestViews, held_out_by, held_out_views
from morgs_mi.capture.layouts.calibration import CalibratedView
from morgs_mi.capture.layouts.clips import EXAMPLE, check_names
from morgs_mi.capture.layouts.reader_registry import find_reader
from morgs_mi.capture.recorded_view import RecordedView
from morgs_mi.capture.timeline import ClipTimes, ReadConfig, timeline
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import display_stops
from morgs_mi.core.rig import with_near_planes
from morgs_mi.core.view import View, Views
from morgs_mi.io.clip_readers import FrameReader, open_clips
from morgs_mi.io.images import ImageOrError
from morgs_mi.io.prefetch import prefetched
from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.checks import check_number, check_points, composed, quantity
from morgs_mi.platform.files import CAPTURE

_LOG = logging.getLogger(__name__)
# Pixels of the shorter side that a downscaled image needs.
MIN_SIDE = 32


@dataclass(frozen=True)
class Frame:
    """One timestamp in all views."""

    index: int  #: Position in the recording, from 0.
    #: The views with their images: uint8 in sRGB, or of EXR files float32 in linear light.
    views: Views[View]

    @property
    def images(self) -> tuple[np.ndarray, ...]:
        """Per camera [H, W, 3], RGB."""
        return tuple(view.image for view in self.views)

    @property
    def train(self) -> Views[View]:
        """The views that are fitted, with their images."""
        return self.views.train

    @property
    def test(self) -> Views[View]:
        """The views that are held out, with their images."""
        return self.views.test


@dataclass(frozen=True)
class PartialFrame:
    """One timestamp in the views that have an image of it."""

    index: int  #: Position in the recording, from 0.
    views: Views[View]  #: As in `Frame`; a view that lacks the image has none.
    problems: tuple[str, ...] = ()  #: One sentence per missing image.
    #: Views with the images with which the next frame's are compared; None if these are `views`.
    recorded: Views[View] | None = None
    #: Whether an image is missing that the recording should have.
    unread: bool = False

    @classmethod
    def of(
        cls,
        index: int,
        views: Views[Any],
        images: Sequence[ImageOrError],
        before: PartialFrame | None = None,
    ) -> PartialFrame:
        """Return the frame of the images of all views, or of errors in place of missing ones.

        A warning names each view without an image that has one in the frame `before`.
        """
        problems = []
        present = []
        for k, (view, image) in enumerate(zip(views, images, strict=True)):
            present.append(None if isinstance(image, Exception) else image)
            if isinstance(image, Exception):
                problems.append(f"{view.name}: {image}")
                if before is None or before.views[k].has_image:
                    _LOG.warning("frame %d: %s is left out: %s", index, view.name, image)
        return cls(index, views.at(present), tuple(problems))

    @property
    def images(self) -> tuple[np.ndarray | None, ...]:
        """Per camera [H, W, 3], RGB, or None for a missing image."""
        return tuple(view.image if view.has_image else None for view in self.views)

    @property
    def train(self) -> Views[View]:
        """The views that are fitted.

        Raises:
            OSError: images of this timestamp could not be read, and none of these views has one:
                the recording may have disappeared.
        """
        if self.unread and not any(view.has_image for view in self.views.train):
            raise OSError(
                f"frame {self.index}: expected an image of at least one fitted camera, got none "
                f"({self.problems[0].rstrip('.')}); bring the recording back, or end the fit "
                f"before this frame (--frames {self.index})."
            )
        return self.views.train

    @property
    def comparable(self) -> Views[View]:
        """The views that are fitted with the images with which the next frame's are compared;
        errors of `train`.
        """
        return self.train if self.recorded is None else self.recorded.train


@dataclass(frozen=True)
class Capture:
    """A recording of a scene; frames are decoded on demand.

    Attributes:
        path: the capture folder.
        views: cameras after undistortion and downscaling, with masks of the pixels that were
            recorded and are used; ``views.train`` are fitted, ``views.test`` are held out.
        num_frames: frames per camera.
        fps: frames per second.
        points: [P, 3] float32, world units; P = 0 if the layout has none.
        point_colors: [P, 3] float32 in [0, 1].
        truth: folder of ground truth, or None.
        downscale: the downscaling factor.
        layout: name of the folder's layout, e.g. ``COLMAP``.
        reading: how clips that do not match are read.
        notes: a sentence for each unexpected property of the clips, e.g. a variable frame rate.
        display_exposure: of EXR files, stops by which a display brightens them; None: the images
            have 8 bits.
        origin: point [3] of the calibration's world, to which cameras and points are relative;
            other than 0 if the rig is too far from 0 for float32.
    """

    path: Path
    views: Views[RecordedView]
    num_frames: int
    fps: float
    points: np.ndarray
    point_colors: np.ndarray
    truth: Path | None
    downscale: float = 1
    layout: str = ""
    reading: ReadConfig = field(default_factory=ReadConfig)
    notes: tuple[str, ...] = ()
    display_exposure: float | None = None
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_points(self.path, self.points, self.point_colors)

    def __repr__(self) -> str:
        held_out = ", ".join(view.name for view in self.views.test) or "none"
        cameras = quantity(len(self.views), "camera")
        frames = f"{quantity(self.num_frames, 'frame')}, {self.fps:g} frames per second"
        return f"Capture('{self.path}', {self.layout}, {cameras}, {frames}, held out: {held_out})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(view.name for view in self.views)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of all views."""
        return self.views.cameras

    @property
    def masks(self) -> tuple[np.ndarray | None, ...]:
        """The masks of all views."""
        return tuple(view.mask for view in self.views)

    @property
    def train_views(self) -> tuple[int, ...]:
        """Indices of the views that are not held out."""
        return tuple(v for v, view in enumerate(self.views) if not view.held_out)

    @property
    def test_views(self) -> tuple[int, ...]:
        """Indices of the views that are held out."""
        return tuple(v for v, view in enumerate(self.views) if view.held_out)

    @property
    def first_clip(self) -> str:
        """Path of the first camera's video or folder of images, relative to the capture."""
        return os.path.relpath(self.views[0].reader.path, self.path)

    @property
    def reference_view(self) -> int:
        """Index of the first held-out camera, otherwise of the first camera: the one that figures
        show.
        """
        return self.test_views[0] if self.test_views else 0

    def at_recorded_size(self) -> Capture:
        """Return the capture without downscaling, with the same points."""
        if self.downscale == 1:
            return self
        views = Views(view.at_recorded_size() for view in self.views)
        return replace(self, views=views, downscale=1)

    def displayed(self) -> Capture:
        """Return the capture with images of 8 bits: linear light as a display shows it."""
        if self.display_exposure is None:
            return self
        views = (replace(view, display_exposure=self.display_exposure) for view in self.views)
        return replace(self, views=Views(views), display_exposure=None)

    def with_cameras(
        self, cameras: Sequence[Camera], distortions: Sequence[Sequence[float]] = ()
    ) -> Capture:
        """Return the capture, as calibrated, with refined cameras.

        Args:
            cameras: one per view, of the same sizes.
            distortions: per camera the radial terms k1, k2 of the distortion left in the images,
                which is removed as well; empty: none.
        """
        terms = distortions or np.zeros((len(cameras), 2)).tolist()
        changes = zip(self.views, cameras, terms, strict=True)
        return replace(self, views=Views(view.refined(c, *term) for view, c, term in changes))

    def holding_out(self, views: TestViews) -> Capture:
        """Return the capture with other held-out cameras, by indices or names; None for none.

        Raises:
            ValueError: there is no such camera, or none is left for training.
        """
        test = held_out_views(self.path, views, self.names)
        pairs = enumerate(self.views)
        return replace(self, views=Views(replace(view, held_out=v in test) for v, view in pairs))

    def metadata(self) -> JsonObject:
        """Return the reading of the frames in JSON types, as stored in the `capture.json` beside a
        stream.
        """
        return {
            "capture": str(self.path),
            "layout": self.layout,
            "frames": self.num_frames,
            "fps": self.fps,
            "downscale": self.downscale,
            "filter": "none" if self.downscale == 1 else "area",
            "test_view": list(self.test_views),
            "points": len(self.points),
            "reading": {**asdict(self.reading), "without": list(self.reading.without)},
            "notes": list(self.notes),
            "origin": list(self.origin),
            "cameras": [view.metadata() for view in self.views],
        }

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Yield frames start..stop-1, decoded in a background thread.

        Frame 0 has images at its timestamp, which are interpolated where cameras have delays.

        Raises:
            ValueError: a file is truncated or broken; the message names the frame.
            FileNotFoundError: an image is missing.
        """
        for frame in prefetched(self._decoded(start, stop, True)):
            yield Frame(frame.index, frame.views)

    def partial_frames(self, start: int = 0, stop: int | None = None) -> Iterator[PartialFrame]:
        """Yield frames start..stop-1 as `frames` does, with None for a missing image, which is
        logged.
        """
        yield from prefetched(self._decoded(start, stop, False))

    def images(
        self, view: int, start: int = 0, stop: int | None = None
    ) -> Generator[ImageOrError, None, None]:
        """Yield the images of one camera at the frames start..stop-1, with an error in place of a
        missing image.
        """
        frames = range(self.num_frames)[start:stop]
        return self.views[view].images(frames.start, frames.stop)

    def with_delays(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """Return the cameras of a stream of this capture with the delays and readouts of the
        capture's cameras.
        """
        return tuple(
            replace(camera, delay=original.delay, readout=original.readout)
            for camera, original in zip(cameras, self.cameras, strict=True)
        )

    def _decoded(
        self, start: int, stop: int | None, strict: bool
    ) -> Generator[PartialFrame, None, None]:
        streams = [self.images(view, start, stop) for view in range(len(self.views))]
        frame = None
        try:
            for index, images in enumerate(zip(*streams, strict=True), start=start):
                errors = [image for image in images if isinstance(image, Exception)]
                if strict and errors:
                    raise errors[0]
                frame = PartialFrame.of(index, self.views, images, frame)
                if index == 0 and any(view.times.delay for view in self.views):
                    # The motion in the first frame is unknown, so delays cannot be rendered.
                    first = map(RecordedView.at_first_timestamp, self.views, frame.views)
                    frame = replace(frame, views=Views(first), recorded=frame.views)
                # With gaps, timestamps without an image are part of the recording.
                has_gaps = self.reading.gaps and os.path.exists(self.views[0].reader.path)
                yield replace(frame, unread=bool(errors) and not has_gaps)
        finally:
            for stream in streams:
                stream.close()


def load_capture(
    path: str | Path,
    downscale: float = 1,
    test_view: TestViews = "auto",
    max_frames: int | None = None,
    reading: ReadConfig | None = None,
) -> Capture:
    """Open a capture folder: read the calibration and the header of every clip.

    Args:
        path: the folder; `layouts/reader_registry.py` lists the readers.
        downscale: factor by which images are downscaled (area averages, rounded to the nearest
            whole size).
        test_view: index or name of the held-out camera, several of them, or None for none; "auto"
            uses the value in `capture.json`, then the layout's own, then 0 as N3DV does, or none
            with fewer than six cameras.
        max_frames: number of frames to use at most, from the start.
        reading: how clips that do not match are read.

    Example:
        >>> capture = morgs_mi.load_capture("out/demo/capture")
        >>> for frame in capture.frames():
        ...     print(frame.index, frame.images[0].shape)

    Raises:
        FileNotFoundError: the folder, the calibration or a camera's clip is missing.
        ValueError: calibration and clips disagree (number, size, length, frame rate), a file is
            broken, or an argument is out of range.
    """
    path = Path(path)
    _check_arguments(path, downscale, max_frames)
    reading = reading or ReadConfig()
    settings = read_settings(path / CAPTURE)
    layout = find_reader(path)
    every = layout.read(path).centred(path)
    calibration = every.without(path, reading.without)
    readers = open_clips(calibration.clips, reading.gaps, settings.white)
    calibrated = _at_clip_sizes(calibration.views, readers)
    common = timeline(path, readers, reading, max_frames, settings.fps)
    readouts = _readouts(path / CAPTURE, settings.readout, every.names)
    _check_downscale(downscale, calibrated)
    views = []
    for calibrated_view in calibrated:
        name = calibrated_view.name
        times = common.clips[name]
        view = RecordedView.of(calibrated_view, readers[name], times)
        camera = _downscaled(view.camera, downscale, times, readouts.get(name, 0.0))
        views.append(view.with_camera(camera))
    capture = Capture(
        path=path,
        views=Views(views),
        num_frames=common.num_frames,
        fps=common.fps,
        points=calibration.points,
        point_colors=calibration.point_colors,
        # The frames of the ground truth are numbered like the frames of the clips.
        truth=path / "truth" if common.unchanged and (path / "truth").is_dir() else None,
        downscale=downscale,
        layout=layout.name,
        reading=reading,
        notes=(
            *common.notes,
            *(note for view in views for note in view.notes),
            *_photos(calibrated),
        ),
        origin=calibration.origin,
    )
    capture = capture.with_cameras(with_near_planes(capture.cameras, capture.points, reading.near))
    capture = capture.holding_out(
        held_out_by(path, test_view, settings.test_view, every, calibration)
    )
    if not any(reader.has_light for reader in readers.values()):
        return capture
    stops = settings.display_exposure
    if stops is None:
        stops = display_stops(next(capture.partial_frames(0, 1)).images)
    return replace(capture, display_exposure=stops)


def _check_arguments(path: Path, downscale: float, max_frames: int | None) -> None:
    if not path.is_dir():
        kind = "a file" if path.is_file() else "none"
        raise FileNotFoundError(
            f"{path}: expected a capture folder, found {kind}; name one that has a video, or a "
            "folder of images, for each camera."
        )
    check_number("load_capture()", "downscale", downscale, "[1, inf)")
    if max_frames is not None:
        check_number("load_capture()", "max_frames", max_frames, "[1, inf)")


def _at_clip_sizes(
    views: Sequence[CalibratedView], readers: Mapping[str, FrameReader]
) -> list[CalibratedView]:
    """Return the views with cameras at the sizes of their clips, which may be scaled versions.

    Raises:
        ValueError: a clip has another aspect ratio than its camera.
    """
    recorded = []
    for view in views:
        camera = view.camera
        reader = readers[view.name]
        width = reader.width
        height = reader.height
        # Both sides were rounded to whole pixels.
        if abs(camera.width * height - camera.height * width) > min(camera.width, camera.height):
            raise ValueError(
                f"{reader.path}: expected {camera.width}x{camera.height}, the calibrated size of "
                f"{camera.name}, or a scaled version of it, got {width}x{height}; calibrate at "
                "the size of the images."
            )
        recorded.append(replace(view, camera=camera.resized(width, height)))
    return recorded


def _readouts(
    file: Path, setting: float | dict[str, float], names: Sequence[str]
) -> dict[str, float]:
    """Return the readouts of cameras by their names, in frames of the clips; `setting` is a number
    for all of them, or an object with some.
    """
    readouts = setting if isinstance(setting, dict) else dict.fromkeys(names, setting)
    check_names(file, "readout", readouts, names)
    return {composed(name): readout for name, readout in readouts.items()}


def _check_downscale(downscale: float, views: Sequence[CalibratedView]) -> None:
    """Check that downscaled images have the least size."""
    shortest = min(min(view.camera.size) for view in views)
    if downscale > 1 and round(shortest / downscale) < MIN_SIDE:
        largest = max(1, shortest / MIN_SIDE)
        raise ValueError(
            f"load_capture(): `downscale` must leave images of at least {MIN_SIDE} pixels on each "
            f"side, got {downscale:g}; use at most {np.floor(100 * largest) / 100:g}."
        )


def _downscaled(camera: Camera, downscale: float, times: ClipTimes, readout: float) -> Camera:
    """Return the downscaled camera of a clip with its delay and its readout, which is in frames of
    the clip and of the camera in timestamps.
    """
    size = (round(camera.width / downscale), round(camera.height / downscale))
    delay = times.delay / times.rate
    return replace(camera.resized(*size), delay=delay, readout=readout / times.rate)


def _photos(views: Sequence[CalibratedView]) -> list[str]:
    """Return a note if each clip is a photo."""
    if not all(isinstance(view.clip, tuple) and len(view.clip) == 1 for view in views):
        return []
    return [f"{len(views)} photos of a static scene, one per camera; a recording has {EXAMPLE}"]

"""A multi-view recording: pinhole cameras and their synchronised frames.

`layouts/reader_registry.py` finds the reader of a capture folder, `layouts/clips.py` finds
each camera's clip. An optional ``capture.json`` has settings (see `timeline.read_settings`);
``truth/`` may hold ground truth.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Generator, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from morgs_mi.capture.camera_source import CameraSource
from morgs_mi.capture.held_out import TestViews, held_out_by, held_out_views
from morgs_mi.capture.layouts.clips import EXAMPLE, check_names
from morgs_mi.capture.layouts.reader_registry import find_reader
from morgs_mi.capture.lens import Lens, undistortion
from morgs_mi.capture.timeline import ClipTimes, ReadConfig, read_settings, timeline
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import check_points, composed, few, quantity
from morgs_mi.core.color_space import display_stops
from morgs_mi.core.files import CAPTURE
from morgs_mi.core.rig import with_near_planes
from morgs_mi.io.clip_readers import FrameReader, open_clips
from morgs_mi.io.images import ImageOrError
from morgs_mi.io.prefetch import prefetched

_LOG = logging.getLogger(__name__)
# Pixels of the shorter side that a downscaled image needs.
MIN_SIDE = 32


@dataclass(frozen=True)
class Frame:
    """One timestamp in all views."""

    index: int  #: Position in the recording, from 0.
    #: Per camera [H, W, 3], RGB: uint8 in sRGB, or of EXR files float32 in linear light.
    images: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class PartialFrame:
    """One timestamp in the views that have an image of it."""

    index: int  #: Position in the recording, from 0.
    images: tuple[np.ndarray | None, ...]  #: As in `Frame`, None for a missing image.
    problems: tuple[str, ...] = ()  #: One sentence per missing image.
    #: Reference images for the next frame's images; None if these are `images`.
    recorded: tuple[np.ndarray | None, ...] | None = None
    #: Whether an image is missing that the recording should have.
    unread: bool = False

    def check_images(self, views: Sequence[int]) -> None:
        """Raise `OSError` if images of this timestamp could not be read, and none of some views is
        left: the recording may have disappeared.
        """
        if self.unread and all(self.images[view] is None for view in views):
            raise OSError(
                f"frame {self.index}: expected an image of at least one fitted camera, got none "
                f"({self.problems[0].rstrip('.')}); bring the recording back, or end the fit "
                f"before this frame (--frames {self.index})."
            )

    def comparable(self, views: Sequence[int]) -> list[np.ndarray | None]:
        """Return the reference images of some views for the images of the next frame; errors of
        `check_images`.
        """
        self.check_images(views)
        images = self.images if self.recorded is None else self.recorded
        return [images[view] for view in views]


@dataclass(frozen=True)
class Capture:
    """A recording of a scene; frames are decoded on demand.

    Attributes:
        path: the capture folder.
        cameras: the views after undistortion and downscaling.
        num_frames: frames per camera.
        fps: frames per second.
        points: [P, 3] float32, world units; P = 0 if the layout has none.
        point_colors: [P, 3] float32 in [0, 1].
        masks: per camera [H, W] bool, true where the undistorted pixel was recorded and is used;
            None if all are.
        test_views: indices of the cameras held out from training, in ascending order.
        truth: folder of ground truth, or None.
        downscale: the downscaling factor.
        layout: name of the folder's layout, e.g. ``COLMAP``.
        reading: how clips that do not match are read.
        notes: a sentence for each unexpected property of the clips, e.g. a variable frame rate.
        distortions: per camera the radial terms k1, k2 of the distortion left in the images, which
            is removed as well; empty if there is none.
        display_exposure: of EXR files, stops by which a display brightens them; None: the images
            have 8 bits.
        origin: point [3] of the calibration's world, to which `cameras` and `points` are relative;
            other than 0 if the rig is too far from 0 for float32.
    """

    path: Path
    cameras: tuple[Camera, ...]
    num_frames: int
    fps: float
    points: np.ndarray
    point_colors: np.ndarray
    masks: tuple[np.ndarray | None, ...]
    test_views: tuple[int, ...]
    truth: Path | None
    _sources: tuple[CameraSource, ...] = field(repr=False)
    downscale: float = 1
    layout: str = ""
    reading: ReadConfig = field(default_factory=ReadConfig)
    notes: tuple[str, ...] = ()
    distortions: tuple[tuple[float, float], ...] = ()
    display_exposure: float | None = None
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_points(self.path, self.points, self.point_colors)

    def __repr__(self) -> str:
        held_out = ", ".join(self.names[view] for view in self.test_views) or "none"
        cameras = quantity(len(self.cameras), "camera")
        frames = f"{quantity(self.num_frames, 'frame')}, {self.fps:g} frames per second"
        return f"Capture('{self.path}', {self.layout}, {cameras}, {frames}, held out: {held_out})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def train_views(self) -> tuple[int, ...]:
        """Indices of the cameras that are not held out."""
        return tuple(i for i in range(len(self.cameras)) if i not in self.test_views)

    @property
    def first_clip(self) -> str:
        """Path of the first camera's video or folder of images, relative to the capture."""
        return os.path.relpath(self._sources[0].reader.path, self.path)

    @property
    def reference_view(self) -> int:
        """Index of the first held-out camera, otherwise of the first camera: the one that figures
        show.
        """
        return self.test_views[0] if self.test_views else 0

    @property
    def recorded_sizes(self) -> tuple[tuple[int, int], ...]:
        """Width and height of the cameras' clips."""
        return tuple((source.reader.width, source.reader.height) for source in self._sources)

    def at_recorded_size(self) -> Capture:
        """Return the capture without downscaling, with the same points."""
        if self.downscale == 1:
            return self
        cameras = tuple(
            c.resized(*size) for c, size in zip(self.cameras, self.recorded_sizes, strict=True)
        )
        return replace(self, cameras=cameras, masks=_masks(self._sources, cameras), downscale=1)

    def displayed(self) -> Capture:
        """Return the capture with images of 8 bits: linear light as a display shows it."""
        if self.display_exposure is None:
            return self
        stops = self.display_exposure
        sources = tuple(replace(source, display_exposure=stops) for source in self._sources)
        return replace(self, _sources=sources, display_exposure=None)

    def with_cameras(
        self, cameras: Sequence[Camera], distortions: Sequence[Sequence[float]] = ()
    ) -> Capture:
        """Return the capture, as calibrated, with refined cameras.

        Args:
            cameras: one per view, of the same sizes.
            distortions: per camera the radial terms k1, k2 of the distortion left in the images,
                which is removed as well; empty: none.
        """
        rig = replace(self, cameras=tuple(cameras))
        if not np.any(distortions):
            return rig
        radial_terms = tuple((float(k1), float(k2)) for k1, k2 in distortions)
        rigs = (self.at_recorded_size().cameras, rig.at_recorded_size().cameras)
        sources = []
        for source, camera, refined, terms in zip(self._sources, *rigs, radial_terms, strict=True):
            maps = undistortion(camera, source.lens, (refined, Lens("RADIAL", terms)))
            sources.append(replace(source, undistortion=maps))
        masks = _masks(sources, rig.cameras)
        return replace(rig, masks=masks, _sources=tuple(sources), distortions=radial_terms)

    def holding_out(self, views: TestViews) -> Capture:
        """Return the capture with other held-out cameras, by indices or names; None for none.

        Raises:
            ValueError: there is no such camera, or none is left for training.
        """
        return replace(self, test_views=held_out_views(self.path, views, self.names))

    def process(self, view: int, image: np.ndarray) -> np.ndarray:
        """Return a recorded image of a camera undistorted, downscaled and colour-corrected, like
        its frames.
        """
        return self._sources[view].process(image, self.cameras[view])

    def metadata(self) -> dict[str, Any]:
        """Return the reading of the frames in JSON types, as stored in the `capture.json` beside a
        stream.
        """
        views = zip(self.cameras, self._sources, self.masks, strict=True)
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
            "cameras": [
                {
                    "name": camera.name,
                    "first_frame": int(source.times.frame_indices[0]),
                    "recorded_size": [source.reader.width, source.reader.height],
                    "size": [camera.width, camera.height],
                    "K": camera.K.tolist(),
                    "lens": source.lens.model,
                    "distortion": list(source.lens.distortion),
                    "undistortion": "none"
                    if source.undistortion is None
                    else "cubic, same intrinsics",
                    "valid_share": 1.0 if mask is None else float(mask.mean()),
                    **({"delay": camera.delay} if camera.delay else {}),
                    **({"readout": camera.readout} if camera.readout else {}),
                }
                for camera, source, mask in views
            ],
        }

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Yield frames start..stop-1, decoded in a background thread.

        Frame 0 has images at its timestamp, which are interpolated where cameras have delays.

        Raises:
            ValueError: a file is truncated or broken; the message names the frame.
            FileNotFoundError: an image is missing.
        """
        for frame in prefetched(self._decoded(start, stop, True)):
            yield Frame(frame.index, cast(tuple[np.ndarray, ...], frame.images))

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
        stop = self.num_frames if stop is None else min(stop, self.num_frames)
        return self._sources[view].images(self.cameras[view], start, stop)

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
        streams = [self.images(view, start, stop) for view in range(len(self.cameras))]
        missing: set[str] = set()
        try:
            for index, results in enumerate(zip(*streams, strict=True), start=start):
                images = tuple(None if isinstance(f, Exception) else f for f in results)
                pairs = zip(self.names, results, strict=True)
                errors = {name: f for name, f in pairs if isinstance(f, Exception)}
                if strict and errors:
                    raise next(iter(errors.values()))
                for name in errors.keys() - missing:
                    _LOG.warning("frame %d: %s is left out: %s", index, name, errors[name])
                missing = set(errors)
                # With gaps, timestamps without an image are part of the recording.
                unread = bool(errors) and not (
                    self.reading.gaps and os.path.exists(self._sources[0].reader.path)
                )
                problems = tuple(f"{name}: {error}" for name, error in errors.items())
                recorded = None
                if index == 0 and any(source.times.delay for source in self._sources):
                    # The motion in the first frame is unknown, so delays cannot be rendered. An
                    # image that cannot be interpolated stays as it is.
                    recorded = images
                    first_images = list(images)
                    for view, source in enumerate(self._sources):
                        if images[view] is not None and source.times.delay:
                            source = source.at_timestamps()
                            result = next(source.images(self.cameras[view], 0, 1))
                            if isinstance(result, np.ndarray):
                                first_images[view] = result
                    images = tuple(first_images)
                yield PartialFrame(index, images, problems, recorded, unread)
        finally:
            for stream in streams:
                stream.close()


def _masks(
    sources: Sequence[CameraSource], cameras: Sequence[Camera]
) -> tuple[np.ndarray | None, ...]:
    """Return the masks of the valid pixels of cameras, None where all are valid."""
    return tuple(map(CameraSource.mask, sources, cameras))


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
    if not path.is_dir():
        kind = "a file" if path.is_file() else "none"
        raise FileNotFoundError(
            f"{path}: expected a capture folder, found {kind}; name one that has a video, or a "
            "folder of images, for each camera."
        )
    if not downscale >= 1:
        raise ValueError(f"load_capture(): `downscale` must be at least 1, got {downscale}.")
    if max_frames is not None and max_frames < 1:
        raise ValueError(f"load_capture(): `max_frames` must be at least 1, got {max_frames}.")
    reading = reading or ReadConfig()
    settings = read_settings(path / CAPTURE)
    reader = find_reader(path)
    every = reader.read(path).centred(path)
    calibration = every.without(path, reading.without)
    readers = open_clips(calibration.clips, reading.gaps, settings.get("white"))
    recorded = _at_clip_sizes(path, calibration.cameras, readers)
    names = [camera.name for camera in recorded]
    common = timeline(path, names, readers, reading, max_frames, settings.get("fps"))
    masks = calibration.masks or ((),) * len(readers)
    sources = tuple(
        map(CameraSource.of, readers, calibration.lenses, recorded, masks, common.clips)
    )
    readouts: Any = settings.get("readout", 0.0)
    if not isinstance(readouts, dict):
        readouts = dict.fromkeys(names, readouts)
    check_names(path / CAPTURE, "readout", readouts, every.names)
    readouts = {composed(name): readout for name, readout in readouts.items()}
    readouts = [readouts.get(name, 0.0) for name in names]
    cameras = _downscaled_cameras(recorded, downscale, common.clips, readouts)
    cameras = with_near_planes(cameras, calibration.points, reading.near)
    notes = [*common.notes, *(note for source in sources for note in source.notes)]
    photos = [clip[0] for clip in calibration.clips if isinstance(clip, tuple) and len(clip) == 1]
    if len(photos) == len(readers) and len({file.parent for file in photos}) == 1:
        notes.append(
            f"{len(photos)} photos of a static scene, one per camera; a recording has {EXAMPLE}"
        )
    capture = Capture(
        path=path,
        cameras=cameras,
        num_frames=len(common.clips[0].frame_indices),
        fps=common.fps,
        points=calibration.points,
        point_colors=calibration.point_colors,
        masks=_masks(sources, cameras),
        test_views=held_out_by(path, test_view, settings, every, calibration),
        # The frames of the ground truth are numbered like the frames of the clips.
        truth=path / "truth" if common.unchanged and (path / "truth").is_dir() else None,
        _sources=sources,
        downscale=downscale,
        layout=reader.name,
        reading=reading,
        notes=tuple(notes),
        origin=calibration.origin,
    )
    if any(reader.has_light for reader in readers):
        stops = settings.get("display_exposure")
        if stops is None:
            stops = display_stops(next(capture.partial_frames(0, 1)).images)
        capture = replace(capture, display_exposure=stops)
    return capture


def _at_clip_sizes(
    path: Path, cameras: Sequence[Camera], readers: Sequence[FrameReader]
) -> list[Camera]:
    """Return the cameras at the sizes of their clips, with a warning if a size differs.

    Raises:
        ValueError: a clip has another aspect ratio than its camera.
    """
    recorded = []
    scaled = []
    for camera, reader in zip(cameras, readers, strict=True):
        width = reader.width
        height = reader.height
        # Both sides were rounded to whole pixels.
        if abs(camera.width * height - camera.height * width) > min(camera.width, camera.height):
            raise ValueError(
                f"{reader.path}: expected {camera.width}x{camera.height}, the calibrated size of "
                f"{camera.name}, or a scaled version of it, got {width}x{height}; calibrate at "
                "the size of the images."
            )
        recorded.append(camera.resized(width, height))
        if (width, height) != camera.size:
            scaled.append(recorded[-1])
    if scaled:
        _LOG.warning(
            "%s: the clips of %s do not have the calibrated size (the first has %dx%d); the "
            "intrinsics are scaled.",
            path,
            few([c.name for c in scaled]),
            scaled[0].width,
            scaled[0].height,
        )
    return recorded


def _downscaled_cameras(
    recorded: Sequence[Camera],
    downscale: float,
    clips: Sequence[ClipTimes],
    readouts: Sequence[float],
) -> list[Camera]:
    """Return the downscaled cameras of clips, with their delays and readouts: `readouts` are in
    frames of the clips, the cameras' in timestamps.
    """
    shortest = min(min(camera.width, camera.height) for camera in recorded)
    if downscale > 1 and round(shortest / downscale) < MIN_SIDE:
        largest = shortest / MIN_SIDE
        remedy = f"use at most {np.floor(100 * largest) / 100:g}" if largest >= 1 else "use 1"
        raise ValueError(
            f"load_capture(): `downscale` must leave images of at least {MIN_SIDE} pixels on each "
            f"side, got {downscale:g}; {remedy}."
        )
    cameras = []
    for camera, times, readout in zip(recorded, clips, readouts, strict=True):
        size = (round(camera.width / downscale), round(camera.height / downscale))
        delay = times.delay / times.rate
        cameras.append(replace(camera.resized(*size), delay=delay, readout=readout / times.rate))
    return cameras

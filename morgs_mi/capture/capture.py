"""A multi-view recording as the rest of the package sees it: pinhole cameras and their frames.

`layouts.py` finds out how a folder is laid out, `views.py` where each camera's frames lie. Beside them,
``capture.json`` may give ``test_view`` (index or null) and ``fps``; ``truth/`` may hold ground truth.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from morgs_mi.capture.camera_source import CameraSource, at_clip_size
from morgs_mi.capture.color_correction import ColorCorrection, ColorFit, fit_colors
from morgs_mi.capture.layouts.registry import Calibration, read_calibration
from morgs_mi.capture.lens import undistortion
from morgs_mi.capture.timeline import ReadConfig, read_settings, timeline
from morgs_mi.core.camera import Camera
from morgs_mi.io.prefetch import prefetched
from morgs_mi.io.video import open_clips

__all__ = ["Capture", "Frame", "PartialFrame", "load_capture"]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Frame:
    """One instant in all views.

    Attributes:
        index: position in the recording, from 0.
        images: per camera uint8 [H, W, 3], RGB, display-referred.
    """

    index: int
    images: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class PartialFrame:
    """One instant in those views that have a picture of it.

    Attributes:
        index: position in the recording, from 0.
        images: as in `Frame`, None where there is no picture.
        problems: a sentence for each of these.
    """

    index: int
    images: tuple[np.ndarray | None, ...]
    problems: tuple[str, ...] = ()


@dataclass(frozen=True)
class Capture:
    """A recording of a scene; frames are decoded when asked for.

    Attributes:
        path: its folder.
        cameras: the views after undistortion and downscaling.
        num_frames: frames per camera.
        fps: frames per second.
        points: [P, 3] float32, world units; P = 0 without a COLMAP model.
        point_colors: [P, 3] float32 in [0, 1].
        masks: per camera [H, W] bool, true where the undistorted pixel was recorded; None for everywhere.
        test_view: index of the camera held out from training, or None.
        truth: folder of ground truth, or None.
        downscale: the factor that it was opened with.
        layout: how its folder is laid out, e.g. ``COLMAP``.
        reading: how its clips are put together.
        colors: how the cameras' colours are corrected, or None.
    """

    path: Path
    cameras: tuple[Camera, ...]
    num_frames: int
    fps: float
    points: np.ndarray
    point_colors: np.ndarray
    masks: tuple[np.ndarray | None, ...]
    test_view: int | None
    truth: Path | None
    _sources: tuple[CameraSource, ...] = field(repr=False)
    downscale: float = 1
    layout: str = ""
    reading: ReadConfig = field(default_factory=ReadConfig)
    colors: ColorFit | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def train_views(self) -> tuple[int, ...]:
        """Indices of the cameras that are not held out."""
        return tuple(i for i in range(len(self.cameras)) if i != self.test_view)

    @property
    def recorded_sizes(self) -> tuple[tuple[int, int], ...]:
        """Width and height of the cameras' clips."""
        return tuple((source.reader.width, source.reader.height) for source in self._sources)

    def seen(self, view: int, image: np.ndarray) -> np.ndarray:
        """Return a picture that a camera has recorded as its frames are: undistorted, downscaled, corrected."""
        return self._sources[view].seen(image, self.cameras[view])

    def record(self) -> dict[str, Any]:
        """Return how the frames come about, for `capture.json` beside a stream: what JSON takes, and small."""
        views = zip(self.cameras, self._sources, self.masks, strict=True)
        fit = self.colors
        colors = fit and {"reference": self.names[fit.reference], "delta_e_before": fit.before, "delta_e": fit.after}
        return {
            "capture": str(self.path),
            "layout": self.layout,
            "frames": self.num_frames,
            "fps": self.fps,
            "downscale": self.downscale,
            "filter": "none" if self.downscale == 1 else "area",
            "test_view": self.test_view,
            "points": len(self.points),
            "reading": asdict(self.reading),
            "colors": colors,
            "cameras": [
                {
                    "name": camera.name,
                    "first_frame": int(source.picks[0]),
                    "recorded_size": [source.reader.width, source.reader.height],
                    "size": [camera.width, camera.height],
                    "K": camera.K.tolist(),
                    "lens": source.lens.model,
                    "distortion": list(source.lens.distortion),
                    "undistortion": "none" if source.undo is None else "cubic, same intrinsics",
                    "valid_share": 1.0 if mask is None else float(mask.mean()),
                }
                for camera, source, mask in views
            ],
        }

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Yield frames start..stop-1, decoded in the background as they are needed.

        Raises:
            ValueError: a file is truncated or broken (named with the frame).
            FileNotFoundError: an image is missing.
        """
        for index, images, _ in prefetched(self._decoded(start, stop, True)):
            yield Frame(index, images)

    def partial_frames(self, start: int = 0, stop: int | None = None) -> Iterator[PartialFrame]:
        """Yield what can be had of frames start..stop-1, as `frames` does: what is missing is None, and logged."""
        for frame in prefetched(self._decoded(start, stop, False)):
            yield PartialFrame(*frame)

    def _decoded(self, start: int, stop: int | None, strict: bool) -> Iterator[tuple[int, tuple, tuple[str, ...]]]:
        stop = self.num_frames if stop is None else min(stop, self.num_frames)
        streams = [s.pictures(c, start, stop) for s, c in zip(self._sources, self.cameras, strict=True)]
        gone: set[str] = set()
        try:
            for index, pictures in enumerate(zip(*streams, strict=True), start=start):
                errors = {n: p for n, p in zip(self.names, pictures, strict=True) if isinstance(p, Exception)}
                if strict and errors:
                    raise next(iter(errors.values()))
                for name in errors.keys() - gone:
                    _LOG.warning("frame %d: %s is left out: %s", index, name, errors[name])
                gone = set(errors)
                images = tuple(None if isinstance(p, Exception) else p for p in pictures)
                yield index, images, tuple(f"{name}: {error}" for name, error in errors.items())
        finally:
            for stream in streams:
                stream.close()


def load_capture(
    path: str | Path,
    downscale: float = 1,
    test_view: int | Literal["auto"] | None = "auto",
    max_frames: int | None = None,
    reading: ReadConfig | None = None,
) -> Capture:
    """Open a capture folder: read the calibration and the head of every clip.

    Args:
        path: the folder; see the module for its layouts.
        downscale: images are averaged down by this factor, to the nearest whole size.
        test_view: index of the camera to hold out, None for none; "auto" takes `capture.json`'s, else the
            layout's, else 0 as N3DV does, or none with fewer than six cameras.
        max_frames: use at most this many frames from the start.
        reading: what to do with clips that do not fit each other.

    Raises:
        FileNotFoundError: the folder, the calibration or a camera's clip is missing.
        ValueError: calibration and clips disagree (number, size, length, frame rate), a file is broken, or
            an argument is out of range.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected a capture folder, found none; check the path.")
    if not downscale >= 1:
        raise ValueError(f"load_capture(): `downscale` must be at least 1, got {downscale}.")
    if max_frames is not None and max_frames < 1:
        raise ValueError(f"load_capture(): `max_frames` must be at least 1 or None, got {max_frames}.")
    reading, settings = reading or ReadConfig(), read_settings(path / "capture.json")
    calibration = read_calibration(path)
    readers = open_clips(calibration.clips, reading.gaps)
    recorded = [at_clip_size(c, r) for c, r in zip(calibration.cameras, readers, strict=True)]
    if scaled := [new for old, new in zip(calibration.cameras, recorded, strict=True) if new is not old]:
        _LOG.warning(
            "%s: the clips of %s are not of the size that was calibrated, %dx%d for one: the intrinsics are scaled.",
            *(path, ", ".join(c.name for c in scaled), scaled[0].width, scaled[0].height),
        )
    names = [camera.name for camera in recorded]
    clock = timeline(path, names, readers, reading, max_frames, settings.get("fps"))
    sources = tuple(
        CameraSource(reader, lens, undistortion(camera, lens), picks)
        for reader, lens, camera, picks in zip(readers, calibration.lenses, recorded, clock.picks, strict=True)
    )
    cameras = tuple(_resized(camera, downscale) for camera in recorded)
    capture = Capture(
        path=path,
        cameras=cameras,
        num_frames=len(clock.picks[0]),
        fps=clock.fps,
        points=calibration.points,
        point_colors=calibration.point_colors,
        masks=tuple(s.mask(c) for s, c in zip(sources, cameras, strict=True)),
        test_view=_test_view(path, test_view, settings, calibration),
        # Its frames are the clips', counted from their beginning.
        truth=path / "truth" if clock.plain and (path / "truth").is_dir() else None,
        _sources=sources,
        downscale=downscale,
        layout=calibration.layout,
        reading=reading,
    )
    return _toned(capture, reading) if reading.color != "none" or reading.exposure else capture


def _toned(capture: Capture, reading: ReadConfig) -> Capture:
    """Return the capture with colours that agree between its cameras and over time, as far as that is asked for."""
    if reading.color_reference not in ("", *capture.names):
        raise ValueError(
            f"{capture.path}: `color_reference` must be one of {', '.join(capture.names)}, got "
            f"{reading.color_reference!r}."
        )
    firsts = next(capture.partial_frames(0, 1)).images
    reference = capture.names.index(reading.color_reference) if reading.color_reference else None
    fit = None
    if reading.color != "none":
        fit = fit_colors(capture.cameras, firsts, capture.masks, reading.color, reference)
    tones = [ColorCorrection.of(fit, view, first if reading.exposure else None) for view, first in enumerate(firsts)]
    sources = tuple(replace(s, tone=tone) for s, tone in zip(capture._sources, tones, strict=True))
    return replace(capture, _sources=sources, colors=fit)


def _resized(camera: Camera, downscale: float) -> Camera:
    if downscale == 1:
        return camera
    return camera.resized(max(1, round(camera.width / downscale)), max(1, round(camera.height / downscale)))


def _test_view(
    path: Path, asked: int | Literal["auto"] | None, settings: dict[str, Any], calibration: Calibration
) -> int | None:
    num_cameras = len(calibration.cameras)
    if asked == "auto":
        usual = 0 if num_cameras >= 6 else None
        asked = settings.get("test_view", usual if calibration.test_view is None else calibration.test_view)
    if asked is not None and not 0 <= asked < num_cameras:
        raise ValueError(
            f"{path}: `test_view` must be in 0..{num_cameras - 1}, or None for no held-out view, got {asked}."
        )
    return asked

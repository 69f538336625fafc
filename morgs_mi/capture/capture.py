"""A multi-view recording as the rest of the package sees it: pinhole cameras and their frames.

`layouts.py` finds out how a folder is laid out, `views.py` where each camera's frames lie. Beside them,
``capture.json`` may give ``test_view`` (index or null) and ``fps``; ``truth/`` may hold ground truth.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.capture.layouts import Calibration, read_calibration
from morgs_mi.capture.lens import Lens, Undistortion, undistortion
from morgs_mi.capture.video import FrameReader, open_frames

__all__ = ["Capture", "Frame", "load_capture"]

_LOG = logging.getLogger(__name__)
_DEFAULT_FPS = 30.0


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
class _Source:
    """Where one camera's frames come from and what undoes its lens."""

    reader: FrameReader
    lens: Lens
    undo: Undistortion | None

    def images(self, camera: Camera, start: int, stop: int) -> Iterator[np.ndarray]:
        for image in self.reader.frames(start, stop):
            yield _shrunk(self.undo(image) if self.undo else image, camera)

    def mask(self, camera: Camera) -> np.ndarray | None:
        if self.undo is None or self.undo.mask.all():
            return None
        # A shrunk pixel is valid if all that it averages is.
        return _shrunk(self.undo.mask.astype(np.float32), camera) > 1 - 1e-4


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
    _sources: tuple[_Source, ...] = field(repr=False)
    downscale: float = 1
    layout: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def train_views(self) -> tuple[int, ...]:
        """Indices of the cameras that are not held out."""
        return tuple(i for i in range(len(self.cameras)) if i != self.test_view)

    def record(self) -> dict[str, Any]:
        """Return how the frames come about, for `capture.json` beside a stream: what JSON takes, and small."""
        views = zip(self.cameras, self._sources, self.masks, strict=True)
        return {
            "capture": str(self.path),
            "layout": self.layout,
            "frames": self.num_frames,
            "fps": self.fps,
            "downscale": self.downscale,
            "filter": "none" if self.downscale == 1 else "area",
            "test_view": self.test_view,
            "points": len(self.points),
            "cameras": [
                {
                    "name": camera.name,
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
        """Yield frames start..stop-1, one decoded at a time.

        Raises:
            ValueError: a file is truncated or broken (named with the frame).
        """
        stop = self.num_frames if stop is None else min(stop, self.num_frames)
        streams = [s.images(c, start, stop) for s, c in zip(self._sources, self.cameras, strict=True)]
        for index, images in enumerate(zip(*streams, strict=True), start=start):
            yield Frame(index, images)


def load_capture(
    path: str | Path,
    downscale: float = 1,
    test_view: int | Literal["auto"] | None = "auto",
    max_frames: int | None = None,
) -> Capture:
    """Open a capture folder: read the calibration and the head of every clip.

    Args:
        path: the folder; see the module for its layouts.
        downscale: images are averaged down by this factor, to the nearest whole size.
        test_view: index of the camera to hold out, None for none; "auto" takes `capture.json`'s, else the
            layout's, else 0 as N3DV does, or none with fewer than six cameras.
        max_frames: use at most this many frames from the start.

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
    settings = _settings(path / "capture.json")
    calibration = read_calibration(path)
    readers = [open_frames(clip) for clip in calibration.clips]
    recorded = [_recorded(c, r) for c, r in zip(calibration.cameras, readers, strict=True)]
    if scaled := [new for old, new in zip(calibration.cameras, recorded, strict=True) if new is not old]:
        _LOG.warning(
            "%s: the clips of %s are not of the size that was calibrated, %dx%d for one: the intrinsics are scaled.",
            *(path, ", ".join(c.name for c in scaled), scaled[0].width, scaled[0].height),
        )
    sources = tuple(
        _Source(reader, lens, undistortion(camera, lens))
        for reader, lens, camera in zip(readers, calibration.lenses, recorded, strict=True)
    )
    cameras = tuple(_resized(camera, downscale) for camera in recorded)
    return Capture(
        path=path,
        cameras=cameras,
        num_frames=_num_frames(path, readers, max_frames),
        fps=_fps(path, readers, settings.get("fps")),
        points=calibration.points,
        point_colors=calibration.point_colors,
        masks=tuple(s.mask(c) for s, c in zip(sources, cameras, strict=True)),
        test_view=_test_view(path, test_view, settings, calibration),
        truth=path / "truth" if (path / "truth").is_dir() else None,
        _sources=sources,
        downscale=downscale,
        layout=calibration.layout,
    )


def _recorded(camera: Camera, reader: FrameReader) -> Camera:
    """Return the camera at the size of its clip, which may be the calibrated one made smaller or larger."""
    if (reader.width, reader.height) == (camera.width, camera.height):
        return camera
    x, y = reader.width / camera.width, reader.height / camera.height
    # Both sides were rounded to whole pixels.
    if abs(camera.width * y - reader.width) > 1 or abs(camera.height * x - reader.height) > 1:
        raise ValueError(
            f"{reader.path}: expected {camera.width}x{camera.height} as the calibration of {camera.name} says, or "
            f"that scaled, got {reader.width}x{reader.height}; calibrate at the recorded size."
        )
    return camera.resized(reader.width, reader.height)


def _resized(camera: Camera, downscale: float) -> Camera:
    if downscale == 1:
        return camera
    return camera.resized(max(1, round(camera.width / downscale)), max(1, round(camera.height / downscale)))


def _shrunk(image: np.ndarray, camera: Camera) -> np.ndarray:
    if image.shape[:2] == (camera.height, camera.width):
        return image
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def _num_frames(path: Path, readers: list[FrameReader], max_frames: int | None) -> int:
    for reader in readers:
        wanted = min(reader.num_frames, max_frames or reader.num_frames)
        if wanted > reader.num_held:
            raise ValueError(
                f"{reader.path}: frame {reader.num_held} of {reader.num_frames} cannot be read: the file is truncated "
                f"or broken; copy it again or use the first {reader.num_held} frames (max_frames)."
            )
    lengths = [reader.num_frames for reader in readers]
    shortest = min(lengths)
    if max_frames is not None and max_frames <= shortest:
        return max_frames
    if shortest < max(lengths):
        table = ", ".join(f"{r.path.name} {n}" for r, n in zip(readers, lengths, strict=True))
        raise ValueError(
            f"{path}: all cameras must have the same number of frames, got {table}; "
            f"synchronise them, or use the first frames with max_frames={shortest}."
        )
    return shortest


def _fps(path: Path, readers: list[FrameReader], given: float | None) -> float:
    if given is not None:
        return float(given)
    rates = [reader.fps for reader in readers if reader.fps]
    # 29.97 and 30 are one camera written by two programs.
    if rates and max(rates) > 1.01 * min(rates):
        raise ValueError(
            f"{path}: all cameras must have the same frame rate, got {sorted(set(rates))}; resample the "
            "clips, or give the true one as `fps` in capture.json."
        )
    return rates[0] if rates else _DEFAULT_FPS


def _settings(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, got a broken file ({error}); correct it.") from None
    if not isinstance(settings, dict):
        raise ValueError(f"{path}: expected a JSON object, got {type(settings).__name__}; correct it.")
    fps, view = settings.get("fps"), settings.get("test_view")
    if fps is not None and not (isinstance(fps, int | float) and fps > 0):
        raise ValueError(f"{path}: `fps` must be a positive number, got {fps!r}; correct it.")
    if view is not None and type(view) is not int:
        raise ValueError(f"{path}: `test_view` must be a camera's index or null, got {view!r}; correct it.")
    return settings


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

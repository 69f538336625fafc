"""A multi-view recording as the rest of the package sees it: pinhole cameras and their frames.

Layouts (names are ordered numerically, cam_2 before cam_10):

- N3DV: ``cam00.mp4 ...`` beside ``poses_bounds.npy``;
- a COLMAP model in ``sparse/0`` or ``sparse`` whose images are named after the cameras (``cam01.png`` or
  ``cam01/0000.png`` for ``cam01.mp4``). It wins over ``poses_bounds.npy``, for it carries principal
  points and lenses;
- a camera's frames are ``frames/cam01/*.png`` if present, else ``cam01.mp4``, else the folder ``cam01/``;
- ``capture.json`` may give ``test_view`` (index or null) and ``fps``; ``truth/`` may hold ground truth.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.capture.colmap import find_colmap, read_colmap
from morgs_mi.capture.lens import Lens, Undistortion, undistortion
from morgs_mi.capture.poses_bounds import read_poses_bounds
from morgs_mi.capture.video import IMAGE_SUFFIXES, VIDEO_SUFFIXES, FrameReader, natural_key, open_frames

__all__ = ["Capture", "Frame", "load_capture"]

_LOG = logging.getLogger(__name__)
# Folders of a capture that are no camera's even where they hold images.
_NOT_CAMERAS = {"frames", "images", "sparse", "truth"}
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

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def train_views(self) -> tuple[int, ...]:
        """Indices of the cameras that are not held out."""
        return tuple(i for i in range(len(self.cameras)) if i != self.test_view)

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
        test_view: index of the camera to hold out, None for none; "auto" takes `capture.json`'s, else 0
            as N3DV does, or none with fewer than six cameras.
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
    cameras, lenses, places, points, point_colors = _calibration(path)
    readers = [open_frames(place) for place in places]
    for camera, reader in zip(cameras, readers, strict=True):
        if (reader.width, reader.height) != (camera.width, camera.height):
            raise ValueError(
                f"{reader.path}: expected {camera.width}x{camera.height} as the calibration of {camera.name} "
                f"says, got {reader.width}x{reader.height}; calibrate at the recorded size."
            )
    sources = tuple(_Source(r, undistortion(c, lens)) for r, c, lens in zip(readers, cameras, lenses, strict=True))
    cameras = tuple(_resized(camera, downscale) for camera in cameras)
    return Capture(
        path=path,
        cameras=cameras,
        num_frames=_num_frames(path, readers, max_frames),
        fps=_fps(path, readers, settings.get("fps")),
        points=points,
        point_colors=point_colors,
        masks=tuple(s.mask(c) for s, c in zip(sources, cameras, strict=True)),
        test_view=_test_view(path, test_view, settings, len(cameras)),
        truth=path / "truth" if (path / "truth").is_dir() else None,
        _sources=sources,
        downscale=downscale,
    )


def _calibration(
    path: Path,
) -> tuple[tuple[Camera, ...], tuple[Lens, ...], list[Path], np.ndarray, np.ndarray]:
    """Return cameras at full size, their lenses, where their frames lie, points and their colours."""
    views = _find_views(path)
    if not views:
        raise FileNotFoundError(
            f"{path}: expected videos ({', '.join(VIDEO_SUFFIXES)}) or folders of frames, found none; check the path."
        )
    if folder := find_colmap(path):
        model = read_colmap(folder)
        pairs = sorted(zip(model.cameras, model.lenses, strict=True), key=lambda p: natural_key(p[0].name))
        names = [_view_of_image(folder, views, camera.name) for camera, _ in pairs]
        if len(set(names)) < len(names):
            raise ValueError(
                f"{folder}: expected one image per camera, got {len(names)} images of {len(set(names))} "
                "cameras; keep one image of each fixed camera in the model."
            )
        if unused := [name for name in views if name not in names]:
            _LOG.warning("%s does not calibrate %s: not used.", folder, ", ".join(unused))
        cameras = tuple(replace(camera, name=name) for (camera, _), name in zip(pairs, names, strict=True))
        lenses = tuple(lens for _, lens in pairs)
        return cameras, lenses, [views[n] for n in names], model.points, model.point_colors
    if (path / "poses_bounds.npy").exists():
        cameras, _ = read_poses_bounds(path / "poses_bounds.npy", list(views))
        empty = np.zeros((0, 3), np.float32)
        return cameras, (Lens(),) * len(cameras), list(views.values()), empty, empty
    raise FileNotFoundError(
        f"{path}: expected a calibration (sparse/0, sparse or poses_bounds.npy), found none; "
        "run COLMAP on one frame of each camera."
    )


def _find_views(path: Path) -> dict[str, Path]:
    """Return where each camera's frames lie, by its name and in numerical order."""
    folders = [f for f in path.iterdir() if f.name not in _NOT_CAMERAS and _holds_images(f)]
    videos = [f for f in path.iterdir() if f.is_file() and f.suffix.lower() in VIDEO_SUFFIXES]
    lossless = [f for f in (path / "frames").glob("*") if _holds_images(f)]
    found = {f.name: f for f in folders} | {f.stem: f for f in videos} | {f.name: f for f in lossless}
    return {name: found[name] for name in sorted(found, key=natural_key)}


def _holds_images(folder: Path) -> bool:
    return folder.is_dir() and any(f.suffix.lower() in IMAGE_SUFFIXES for f in folder.iterdir())


def _view_of_image(folder: Path, views: dict[str, Path], image: str) -> str:
    """Return the camera that an image of the model belongs to: cam01 for cam01.png and cam01/0000.png."""
    for name in (Path(image).stem, Path(image).parent.name):
        if name in views:
            return name
    raise FileNotFoundError(
        f"{folder}: its image {image!r} needs a clip called {Path(image).stem}, found "
        f"{', '.join(views)}; name the clips after the model's images."
    )


def _resized(camera: Camera, downscale: float) -> Camera:
    if downscale == 1:
        return camera
    return camera.resized(max(1, round(camera.width / downscale)), max(1, round(camera.height / downscale)))


def _shrunk(image: np.ndarray, camera: Camera) -> np.ndarray:
    if image.shape[:2] == (camera.height, camera.width):
        return image
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def _num_frames(path: Path, readers: list[FrameReader], max_frames: int | None) -> int:
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
    path: Path, asked: int | Literal["auto"] | None, settings: dict[str, Any], num_cameras: int
) -> int | None:
    if asked == "auto":
        asked = settings.get("test_view", 0 if num_cameras >= 6 else None)
    if asked is not None and not 0 <= asked < num_cameras:
        raise ValueError(
            f"{path}: `test_view` must be in 0..{num_cameras - 1}, or None for no held-out view, got {asked}."
        )
    return asked

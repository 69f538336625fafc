"""True 3D tracks of a recording: ground truth of synthetic captures, and annotations of TAPVid-3D.

TAPVid-3D (Koppula et al. 2024) annotates the recordings of Panoptic Studio that Dynamic 3D
Gaussians uses, in the layout of `train_meta.json`. A file ``NAME_CAMERA.npz`` holds the tracks of
one view: ``tracks_XYZ`` [T, P, 3] in the camera's axes (OpenCV's), ``visibility`` [T, P],
``queries_xyt`` [P, 3] and ``fx_fy_cx_cy`` [4]. NAME is the name of the capture's folder; the files
lie in that folder or beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.truth import Tracks, load_tracks
from morgs_mi.core.bounded import read_array
from morgs_mi.core.camera import Camera
from morgs_mi.studio.layouts.dynamic3dgs import read_meta

_SHORT_SIDE = 256


@dataclass(frozen=True)
class TrackTruth:
    """True tracks of P points through T frames, in one view or several that see as one."""

    cameras: tuple[Camera, ...]  #: The views.
    points: np.ndarray  #: [P, T, 3], world units.
    #: Bool [P, T], whether any of the views sees the point; None if unknown.
    visible: np.ndarray | None
    queries: np.ndarray  #: int [P], the frame at which each track starts.

    @property
    def pixel(self) -> np.ndarray | None:
        """Width of a pixel at each point [P, T], world units, for an image with a shorter side of
        256; of one view.
        """
        if len(self.cameras) != 1:
            return None
        (camera,) = self.cameras
        return camera.project(self.points)[1] / _focal_length(camera)


def _focal_length(camera: Camera) -> float:
    """Return the focal length in pixels of an image with a shorter side of 256."""
    focal = np.sqrt(camera.K[0, 0] * camera.K[1, 1])
    return focal * _SHORT_SIDE / min(camera.width, camera.height)


def synthetic_tracks(capture: Capture, views: Sequence[int]) -> list[TrackTruth]:
    """Return the tracks of a synthetic capture as the video of some of its views together; empty
    without any.

    A track starts at the first frame in which one of the views sees it. Tracks that none of them
    sees are left out. Without stored visibility, all tracks start at frame 0.
    """
    if capture.truth is None or not (capture.truth / "tracks.npz").is_file():
        return []
    tracks = load_tracks(capture.truth)
    cameras = tuple(capture.cameras[view] for view in views)
    if not all(camera.name in tracks.visible for camera in cameras):
        return [TrackTruth(cameras, tracks.points, None, np.zeros(len(tracks.points), int))]
    return [_from_first_sight(tracks, cameras)]


def _from_first_sight(tracks: Tracks, cameras: tuple[Camera, ...]) -> TrackTruth:
    """Return the tracks that one of the cameras sees, from the first frame in which it does."""
    visible = np.any([tracks.visible[camera.name] for camera in cameras], axis=0)
    mask = visible.any(1)
    return TrackTruth(cameras, tracks.points[mask], visible[mask], visible[mask].argmax(1))


def tapvid3d_tracks(capture: Capture) -> list[TrackTruth]:
    """Return the annotations of TAPVid-3D for a capture, one per annotated view; empty without any.

    Raises:
        ValueError: as `read_annotation`.
    """
    folder = capture.path.resolve()
    # The frames of the annotations are numbered like the frames of the clips.
    if capture.reading.aligns_clips or not (folder / "train_meta.json").is_file():
        return []
    files = _annotations(folder)
    rig = _annotated_rig(folder) if files else {}
    return [read_annotation(file, rig[name]) for name, file in sorted(files.items()) if name in rig]


def _annotations(folder: Path) -> dict[str, Path]:
    """Return the files of a capture's annotations by the name of the view; those in the folder
    precede those beside it.
    """
    files = [
        file for place in (folder, folder.parent) for file in place.glob(f"{folder.name}_*.npz")
    ]
    return {file.stem.removeprefix(f"{folder.name}_"): file for file in reversed(files)}


def _annotated_rig(folder: Path) -> dict[str, Camera]:
    """Return the cameras of a capture by name, those for tests too."""
    metas = [
        file for name in ("train_meta", "test_meta") if (file := folder / f"{name}.json").is_file()
    ]
    return {view.camera.name: view.camera for meta in metas for view in read_meta(meta)}


def read_annotation(path: Path, camera: Camera) -> TrackTruth:
    """Return the annotation of TAPVid-3D for one view, in world units.

    Args:
        path: the file.
        camera: the view.

    Raises:
        ValueError: the file is broken, its arrays do not have the shapes above, or its intrinsics
            are not the camera's.
    """
    arrays = _annotation_arrays(path)
    tracks = arrays["tracks_XYZ"]
    frames = arrays["queries_xyt"][:, 2]
    _check_intrinsics(path, camera, arrays["fx_fy_cx_cy"])
    if not np.isfinite(tracks).all() or not ((frames >= 0) & (frames < len(tracks))).all():
        raise ValueError(
            f"{path}: `tracks_XYZ` must be finite and the frames in `queries_xyt` below "
            f"{len(tracks)}; download it again."
        )
    points = _world_points(tracks, camera).transpose(1, 0, 2)
    visible = arrays["visibility"].T.astype(bool)
    return TrackTruth((camera,), points, visible, frames.astype(int))


def _world_points(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return points [..., 3] in the axes of a camera as points of the world."""
    V = np.asarray(camera.viewmat, np.float64)
    return (points.astype(np.float64) - V[:3, 3]) @ V[:3, :3]


def _annotation_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an annotation by name, with the shapes above."""
    names = ("tracks_XYZ", "visibility", "queries_xyt", "fx_fy_cx_cy")
    arrays = {name: read_array(path, name) for name in names}
    tracks = arrays["tracks_XYZ"]
    T, P = tracks.shape[:2] if tracks.ndim == 3 else (0, 0)
    shapes = ((T, P, 3), (T, P), (P, 3), (4,))
    for (name, array), shape in zip(arrays.items(), shapes, strict=True):
        if array.shape != shape or array.dtype.kind not in "fiub":
            raise ValueError(
                f"{path}: expected `{name}` {[*shape]} with {T} frames and {P} points, got "
                f"{array.dtype} {[*array.shape]}; download the annotation again."
            )
    return arrays


def _check_intrinsics(path: Path, camera: Camera, intrinsics: np.ndarray) -> None:
    """Raise `ValueError` unless an annotation has the intrinsics [4] of its camera."""
    K = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    if not np.allclose(intrinsics, K, rtol=1e-3):
        raise ValueError(
            f"{path}: expected the intrinsics of camera {camera.name}, {K.round(2).tolist()}, got "
            f"{np.round(intrinsics.astype(float), 2).tolist()} in `fx_fy_cx_cy`; use the "
            "annotation of this capture."
        )

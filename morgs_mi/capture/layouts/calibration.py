"""The reader of a capture layout, and helpers that the readers share."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Literal

import numpy as np

from morgs_mi.capture.layouts.clips import (
    EXAMPLE,
    check_frames,
    clip_of_camera,
    clips_by_frame,
    clips_by_rig,
    find_clips,
    names_without,
    photos,
    photos_by_rig,
    view_of_image,
)
from morgs_mi.capture.lens import Lens
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import far_origin, scene_extent
from morgs_mi.io.clip_readers import Clip
from morgs_mi.io.listing import VIDEO_SUFFIXES
from morgs_mi.io.numbering import frames_by_number, natural_key
from morgs_mi.platform.checks import few, require

_LOG = logging.getLogger(__name__)

NO_POINTS = np.zeros((0, 3), np.float32)
"""The points, and their colours, of a layout without points."""


@dataclass(frozen=True)
class CalibratedImage:
    """One image of a calibration. All images of a clip have the same pose and lens."""

    camera: Camera  #: The camera, with the name of the image.
    #: The lens that the image was recorded through.
    lens: Lens = field(default_factory=Lens)
    #: Images of its size or scaled versions, whose black pixels are not used; no images: all pixels
    #: are used.
    masks: tuple[Path, ...] = ()

    @property
    def name(self) -> str:
        """Name of the image."""
        return self.camera.name

    @property
    def pose(self) -> Hashable:
        """The exact pose, intrinsics and lens. They are equal for images of one fixed camera."""
        camera = self.camera
        return camera.world_to_camera.tobytes(), camera.K.tobytes(), camera.size, self.lens


@dataclass(frozen=True)
class CalibratedView(CalibratedImage):
    """A camera of a capture folder, at the calibrated size, with its clip."""

    clip: Clip = field(kw_only=True)  #: A video, a folder of images or a list of images.
    #: The images of the clip that the calibration has.
    images: tuple[CalibratedImage, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """Cameras, clips and points of a capture folder, at the calibrated size."""

    views: tuple[CalibratedView, ...]  #: In numerical order of their names.
    #: [P, 3], world units, in the file's precision; P = 0 if the layout has none.
    points: np.ndarray = field(default_factory=lambda: NO_POINTS)
    #: [P, 3] float32 in [0, 1].
    point_colors: np.ndarray = field(default_factory=lambda: NO_POINTS)
    #: Names of the cameras that the layout holds out; None if it specifies none.
    held_out: tuple[str, ...] | None = None
    #: Point of the file's world that cameras and points are relative to.
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    #: Names of clips without a camera, and of cameras without a clip, which are left out.
    unused: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(view.name for view in self.views)

    @property
    def clips(self) -> dict[str, Clip]:
        """The clips by the names of their cameras."""
        return {view.name: view.clip for view in self.views}

    def centred(self, path: Path) -> Calibration:
        """Return the calibration relative to the `far_origin` of its cameras, with float32 points;
        `path` is the capture, for messages.

        Points that the file has rounded are left out.
        """
        cameras = [view.camera for view in self.views]
        origin = far_origin(cameras)
        result = replace(
            self,
            views=tuple(
                replace(view, camera=view.camera.relative_to(origin)) for view in self.views
            ),
            points=(self.points - origin).astype(np.float32),
            origin=tuple(origin.tolist()),
        )
        if not origin.any():
            return result
        rounding = np.spacing(
            np.abs(origin).max().astype(np.promote_types(self.points.dtype, "f4"))
        )
        coarse = len(self.points) and rounding > 1e-3 * scene_extent(cameras)
        _LOG.warning(
            "%s: its cameras are too far from 0 for float32; coordinates are relative to the origin"
            " (%.10g, %.10g, %.10g)%s.",
            path,
            *origin,
            f", and its points, which are rounded to {rounding:g}, are not used" if coarse else "",
        )
        return replace(result, points=NO_POINTS, point_colors=NO_POINTS) if coarse else result

    def without(self, path: Path, names: Collection[str]) -> Calibration:
        """Return the calibration without the cameras called `names`; `path` is the capture, for
        messages.

        Raises:
            ValueError: there is no such camera or clip, or no camera is left.
        """
        rest = names_without(path, self.names, sorted({*names} - {*self.unused}))
        return replace(self, views=tuple(view for view in self.views if view.name in rest))


@dataclass(frozen=True)
class PoseConvention:
    """Meaning of the 4x4 pose matrices in a calibration file."""

    #: Source and target frame of the matrices.
    direction: Literal["world to camera", "camera to world"] = "world to camera"
    #: OpenCV's (x right, y down, z forward) or OpenGL's (x right, y up, z backward).
    axes: Literal["OpenCV", "OpenGL"] = "OpenCV"


@dataclass(frozen=True)
class Reader:
    """Reader of one layout, i.e. of one way to store a calibration in a capture folder."""

    name: str  #: Name of the layout in reports, e.g. ``COLMAP``.
    #: Names of the files or folders that hold the calibration, for error messages.
    files: tuple[str, ...]
    find: Callable[[Path], bool]  #: Returns whether a capture folder holds such a calibration.
    #: Returns the calibration of a capture folder. Raises FileNotFoundError if a file or clip is
    #: missing and ValueError if a file is broken or does not match the clips.
    read: Callable[[Path], Calibration]
    #: Convention of the pose matrices, which the rig check compares with other ones; None if poses
    #: are not stored as 4x4 matrices.
    poses: PoseConvention | None = PoseConvention()


def calibration_files(path: Path, pattern: str) -> list[Path]:
    """Return the files with a name that matches a pattern in lower case, in a capture or in its
    `calibration`.
    """
    files = [*sorted(path.glob("[!.]*")), *sorted(path.glob("calibration/[!.]*"))]
    return [file for file in files if fnmatch(file.name.lower(), pattern)]


def only_calibration(
    path: Path,
    files: Sequence[Path],
    expected: str,
    read: Callable[[Path], Sequence[CalibratedImage]],
) -> Calibration:
    """Return what `read` reads from the only calibration of a capture; raises as `match_clips`.

    Raises:
        ValueError: there are several.
    """
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise ValueError(
            f"{path}: expected {expected}, got {names}; keep the one of this recording."
        )
    return match_clips(path, files[0], required_clips(path), read(files[0]))


def required_clips(path: Path) -> Mapping[str, Clip]:
    """Return each camera's video, folder of images or photo by the camera's name, in numerical
    order.

    Raises:
        FileNotFoundError: the capture folder has none.
    """
    if clips := find_clips(path):
        return clips
    raise FileNotFoundError(
        f"{path}: expected videos ({', '.join(VIDEO_SUFFIXES)}) or folders of frames, found none; "
        f"check the path, or make {EXAMPLE}"
    )


def match_clips(
    path: Path, source: Path, clips: Mapping[str, Clip], images: Sequence[CalibratedImage]
) -> Calibration:
    """Return the fixed cameras that have a clip, in numerical order of the clips' names.

    Cameras without a clip, and clips without a camera, are left out with a warning. Photos of equal
    pose and lens are the frames of one camera, which has the name of the first.

    Args:
        path: the capture folder; its photos, its frame folders, and clips or photos in folders of
            folders, are used if they match more cameras than `clips`.
        source: file or folder of the calibration, for messages.
        clips: from `required_clips`.
        images: one or more per fixed camera.

    Raises:
        FileNotFoundError: no camera has a clip.
        ValueError: two images of one clip have different poses or lenses, a frame folder is
            missing, or the photos of several cameras have other numbers.
    """
    match = _Match({}, {}, [])
    errors = []
    # Photos and folders of frames may lie beside folders that could be clips, such as `depth`.
    for find in (lambda _: clips, photos, clips_by_frame, clips_by_rig, photos_by_rig):
        try:
            other = _matched(source, find(path), images)
        except ValueError as error:
            errors.append(error)
            continue
        if len(other.images) > len(match.images):
            match = other
        if not other.without:
            break
    if not match.images:
        if errors:
            raise errors[0]
        raise FileNotFoundError(
            f"{source}: expected clips named after its cameras "
            f"{few([image.name for image in images])}, found {few([*clips])}; name the clips "
            "after the cameras, one each: join the chapters of a video."
        )
    first_clip = next(iter(match.clips.values()))
    if isinstance(first_clip, tuple) and len(first_clip) > 1:
        check_frames(path, first_clip)
    if match.without:
        _LOG.warning("%s: no clip is named after %s: left out.", source, few(match.without))
    if extras := sorted(match.clips.keys() - match.images.keys(), key=natural_key):
        _LOG.warning("%s does not calibrate %s: not used.", source, few(extras))
    unused = (*extras, *match.without)
    masks = _masks(path, match.images)
    match = _frames_of_cameras(source, match)
    views = []
    for name in sorted(match.images, key=natural_key):
        frames = match.images[name]
        files = {*masks.get(name, ())}.union(*(frame.masks for frame in frames))
        view = CalibratedView(
            replace(frames[0].camera, name=name),
            frames[0].lens,
            tuple(sorted(files)),
            clip=match.clips[name],
            images=tuple(frames),
        )
        views.append(view)
    return Calibration(tuple(views), unused=unused)


def _masks(path: Path, cameras: Collection[str]) -> dict[str | None, tuple[Path, ...]]:
    """Return the first mask of each camera in the folder ``masks`` of a capture. It has the name of
    an image with ``.png`` added, as COLMAP names it, or in place of the suffix.
    """
    masks: dict[str | None, tuple[Path, ...]] = {}
    for file in sorted((path / "masks").rglob("[!.]*.png")):
        image = file.relative_to(path / "masks").with_suffix("")
        masks.setdefault(view_of_image(cameras, str(image), by_folder=True), (file,))
    if None in masks:
        _LOG.warning(
            "%s: not used, because no camera's image has its name, such as %s.png.png.",
            *masks[None],
            next(iter(cameras)),
        )
    return masks


@dataclass(frozen=True)
class _Match:
    """Clips and the images that belong to them."""

    clips: Mapping[str, Clip]  # clips by name
    images: dict[str, list[CalibratedImage]]  # of each clip that has some, by its name
    without: list[str]  # names of the images that have no clip


def _matched(source: Path, clips: Mapping[str, Clip], images: Sequence[CalibratedImage]) -> _Match:
    """Return the match between clips and images.

    Raises:
        ValueError: two images of one clip have different poses or lenses.
    """
    match = _Match(clips, {}, [])
    # A clip in a folder, or a list of images in any folders, which have the cameras' names.
    by_folder = any(isinstance(clip, Path) for clip in clips.values())
    origin = far_origin([image.camera for image in images])
    for image in images:
        name = image.name
        if name not in clips:
            # The search for a word takes far longer than the one for names.
            name = view_of_image(clips, name, by_folder) or clip_of_camera(clips, name)
        if name is None:
            match.without.append(image.name)
            continue
        images_of_clip = match.images.setdefault(name, [])
        images_of_clip.append(image)
        _check_fixed(source, name, images_of_clip[0], image, origin)
    return match


def _check_fixed(
    source: Path, clip: str, first: CalibratedImage, other: CalibratedImage, origin: np.ndarray
) -> None:
    """Check that two images of a clip have the same pose, relative to `origin` [3], and lens."""
    # Tolerances of poses are relative to their coordinates.
    a = first.camera.relative_to(origin)
    b = other.camera.relative_to(origin)
    if not (
        np.allclose(a.viewmat, b.viewmat, atol=1e-6)
        and np.allclose(a.K, b.K)
        and first.lens == other.lens
    ):
        raise ValueError(
            f"{source}: cameras must not move, but {first.name!r} and {other.name!r}, both of "
            f"{clip}, have different poses or lenses; keep one image of each fixed camera, and "
            "name the clips after them."
        )


def _frames_of_cameras(source: Path, match: _Match) -> _Match:
    """Return the match with one clip, named after the first, for all photos of equal pose and lens.

    Raises:
        ValueError: cameras have several photos each, whose numbers differ between cameras or have
            gaps.
    """
    photos_of: dict[Hashable, dict[str, Path]] = {}
    for name in sorted(match.images, key=natural_key):
        clip = match.clips[name]
        if isinstance(clip, Path) or len(clip) != 1:
            return match
        photos_of.setdefault(match.images[name][0].pose, {})[name] = clip[0]
    if len(photos_of) == len(match.images):
        return match
    cameras = {next(iter(files)): files for files in photos_of.values()}
    numbers = {tuple(frames_by_number(source, files)) for files in cameras.values()}
    steps = np.diff(min(numbers))
    require(
        len(numbers) == 1 and (steps == np.abs(steps[:1])).all(),
        source,
        "images of equal pose and lens are frames of one camera, and all cameras must have images "
        "of the same numbers without gaps",
        few([f"{name} to {list(files)[-1]}" for name, files in cameras.items()], 4),
        f"leave out images that repeat a pose, or make {EXAMPLE}",
    )
    return _Match(
        {name: tuple(files.values()) for name, files in cameras.items()},
        {name: [match.images[file][0] for file in files] for name, files in cameras.items()},
        [],
    )

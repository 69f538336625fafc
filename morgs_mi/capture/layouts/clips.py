"""Search for each camera's clip in a capture folder.

A clip is a video file, a folder of numbered images, or a list of image files (one per frame). Clips
are stored per camera or per frame; cameras are ordered numerically, cam_2 before cam_10:

- per camera: ``cam01.mp4``, ``cam01/0000.png`` or ``cam01/images/0000.png`` (or ``color``,
  ``rgb``), in the capture or in a folder of it (``videos/cam01.mp4``, ``images/cam01/0000.png``).
  Of several clips of one name the one in ``frames/`` takes precedence, then a video, then a folder;
  clips in the capture itself take precedence over those in a folder, and those in the folder
  ``images`` or ``videos`` over those in others, which are otherwise refused;
- per frame: ``0000/cam01.png`` or ``0000/images/cam01.png``, with the same cameras in every folder;
- photos: ``cam01.png`` or ``images/cam01.png``, one image per camera;
- in folders of folders: ``images/rig1/cam01/0000.png`` or photos ``images/day/1.png``, where
  cameras of one name in two folders are called ``rig1_cam01``, and ``cam01/GX010042.MP4``, the only
  video of its folder, as on memory cards.

Images are files of 8 or 16 bits, or EXR files, which have linear light, where a folder has no
others. Folders called after depth, infrared, normals or a mask hold no clips. Files that differ in
their suffixes are refused. Names are compared in their composed form.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import TypeVar

from morgs_mi.io.clip_readers import Clip, open_frames
from morgs_mi.io.listing import VIDEO_SUFFIXES, by_stem, images_in, listed
from morgs_mi.io.numbering import check_numbering, frames_by_number, natural_key
from morgs_mi.platform.checks import composed, few

_LOG = logging.getLogger(__name__)
_Clip = TypeVar("_Clip", Path, tuple[Path])

EXAMPLE = (
    "one folder per camera: cam01/0000.png, cam01/0001.png, ..., cam02/0000.png, cam02/0001.png, "
    "..."
)
"""The layout of a recording in images, for messages."""

# Folders of other images than colours and folders without clips, and folders with images that do
# not belong to a camera of their name.
_NOT_CLIPS = {
    "alpha",
    "depth",
    "depths",
    "infrared",
    "ir",
    "mask",
    "masks",
    "normal",
    "normals",
    "seg",
    "sparse",
    "truth",
}
# Nerfstudio writes downscaled copies to `images_2`, `images_4`, ...
_COPIES = r"images_[0-9]+"
_COLORS = ("images", "color", "rgb")
_NOT_PLACES = re.compile("|".join((*_NOT_CLIPS, "frames", _COPIES)))
_NOT_CAMERAS = re.compile("|".join((_NOT_PLACES.pattern, *_COLORS)))
_USUAL = {"images", "videos"}


def find_clips(path: Path) -> Mapping[str, Clip]:
    """Return each camera's video, folder of images or photo by the camera's name, in numerical
    order; errors of `clips_by_camera`. Folders of other images than colours are not looked at.
    """
    return clips_by_camera(path) or photos(path) or clips_by_rig(path)


def clips_by_camera(path: Path) -> dict[str, Path]:
    """Return each camera's video or folder of images by the camera's name, in numerical order.

    Raises:
        ValueError: two videos in one folder differ only in their suffixes.
    """
    places = _places(path)
    others = [place for place in places if place.name not in _USUAL]
    names = [name for place in others for name in _clips(place)]
    clips: dict[str, Path] = {}
    if len({*names}) < len(names):  # rigs and memory cards repeat the names of their clips
        clips |= clips_by_rig(path)
        places = places[len(others) :]
    for place in places:
        inner = _clips(place)
        if repeats := sorted(inner.keys() & clips.keys()):
            first = clips[repeats[0]].relative_to(path)
            last = inner[repeats[0]].relative_to(path)
            _LOG.warning("%s: clips such as %s are used, not %s.", path, last, first)
        clips |= inner
    clips |= _clips(path)
    if (path / "frames").is_dir():
        clips |= _clips(path / "frames")
    return _in_order(clips)


def clips_by_rig(path: Path) -> dict[str, Path]:
    """Return the clips in folders of folders by their names, with the name of the folder where two
    have the same, and the only videos of folders by the folders' names.
    """

    def clips(folder: Path) -> dict[str, Path]:
        videos = _videos(folder)
        only = len(videos) == 1
        name = composed(folder.name)
        return _folders(folder) | ({name: videos.popitem()[1]} if only else videos)

    return _by_rig(path, clips)


def photos_by_rig(path: Path) -> dict[str, tuple[Path]]:
    """Return the photos in folders of folders as `clips_by_rig`, each as a clip of one frame."""
    return _by_rig(path, _photos)


def _photos(folder: Path) -> dict[str, tuple[Path]]:
    return {name: (image,) for name, image in by_stem(images_in(folder)).items()}


def _by_rig(path: Path, clips: Callable[[Path], dict[str, _Clip]]) -> dict[str, _Clip]:
    """Return the `clips` of the folders in a capture and in its folders."""
    rigs = [rig for place in (path, *_places(path)) for rig in _places(place)]
    clips_of_rigs = [(composed(rig.name), *clip) for rig in rigs for clip in clips(rig).items()]
    unique = len({name for _, name, _ in clips_of_rigs}) == len(clips_of_rigs)
    return _in_order(
        {name if unique else f"{rig}_{name}": clip for rig, name, clip in clips_of_rigs}
    )


def _places(path: Path) -> list[Path]:
    """Return the folders in a capture in which clips are looked for, the usual ones last."""
    inner = [f for f in listed(path) if f.is_dir() and not _NOT_PLACES.fullmatch(f.name)]
    return sorted(inner, key=lambda f: f.name in _USUAL)


def photos(path: Path) -> dict[str, tuple[Path]]:
    """Return the images directly in a folder or its folder `images` as clips of one frame, by their
    names.

    Raises:
        ValueError: two images differ only in their suffixes.
    """
    folder = _image_folder(path)
    return _in_order(_photos(folder)) if folder else {}


def clips_by_frame(path: Path) -> dict[str, tuple[Path, ...]]:
    """Return each camera's images, one per frame folder, by the camera's name; empty without such
    folders.

    The first frame determines the cameras; images that are missing in later frames are listed too.
    """
    frames = [*_in_order(_folders(path)).values()]
    if not frames:
        return {}
    images = _in_order(by_stem(images_in(frames[0])))
    return {name: tuple(f / image.name for f in frames) for name, image in images.items()}


def _in_order(files: Mapping[str, _Clip]) -> dict[str, _Clip]:
    """Return the files in the numerical order of their names."""
    return {name: files[name] for name in sorted(files, key=natural_key)}


def check_frames(path: Path, clip: Sequence[Path]) -> None:
    """Check that the folders of a clip of `clips_by_frame` are numbered without gaps.

    Raises:
        ValueError: a number is missing or occurs twice.
    """
    folders = [path / f.relative_to(path).parts[0] for f in clip]
    check_numbering(path, frames_by_number(path, {folder.name: folder for folder in folders}))


def names_without(path: Path, names: Collection[str], without: Collection[str]) -> list[str]:
    """Return the names of the cameras except `without`; `path` is the capture, for messages.

    Raises:
        ValueError: a camera that is left out does not exist, or all are left out.
    """
    check_names(path, "without", without, names)
    excluded = set(map(composed, without))
    rest = [name for name in names if name not in excluded]
    if without and not rest:
        raise ValueError(f"{path}: `without` must leave at least one camera, got all.")
    return rest


def check_names(place: Path, setting: str, names: Iterable[str], cameras: Collection[str]) -> None:
    """Raise an error unless a setting names cameras; `place` is where it was set.

    Raises:
        ValueError: there is no such camera.
    """
    if unknown := [name for name in names if composed(name) not in cameras]:
        raise ValueError(
            f"{place}: `{setting}` must name cameras of {few([*cameras])}, got {few(unknown)}."
        )


def view_of_image(views: Collection[str], image: str, by_folder: bool = False) -> str | None:
    """Return the camera in `views` to which an image of a calibration belongs, or None.

    It is cam01 for ``cam01.png``, ``cam01.mp4``, ``cam01``, ``cam01/0000.png`` and
    ``cam01/images/0000.png``. Of ``1/2.png`` it is 1_2 if that is a view, otherwise 2, or with
    `by_folder` 1, if there are both.
    """
    place = PurePosixPath(composed(image).replace("\\", "/"))
    folders = place.parts[-2::-1]
    file_names = (place.stem, place.name)
    pairs = pairwise((*place.parts[:-1], place.stem))
    names = (*folders, *file_names) if by_folder else (*file_names, *folders)
    names = (*map("_".join, pairs), *names)
    return next((name for text in names for name in (text, text.strip()) if name in views), None)


def clip_of_camera(clips: Collection[str], camera: str) -> str | None:
    """Return the clip called `camera`, otherwise the only one with this word in its name
    (``trial_2-camA``).
    """
    camera = composed(camera)
    if camera in clips:
        return camera
    word = re.compile(rf"(?<![A-Za-z0-9]){re.escape(camera)}(?![A-Za-z0-9])")
    matches = set(filter(word.search, clips))
    return matches.pop() if len(matches) == 1 else None


def size_of_clip(clip: Clip) -> tuple[int, int]:
    """Return the width and height of a clip by its video or its first image.

    Raises:
        ValueError: it cannot be read.
    """
    if isinstance(clip, Path) and clip.is_dir():
        clip = (images_in(clip)[0],)
    reader = open_frames(clip, gaps=True)
    return reader.width, reader.height


def _clips(folder: Path) -> dict[str, Path]:
    """Return the folders of images and the videos in a folder by their names; a video takes
    precedence.
    """
    return _folders(folder) | _videos(folder)


def _folders(folder: Path) -> dict[str, Path]:
    inner = [f for f in listed(folder) if f.is_dir() and not _NOT_CAMERAS.fullmatch(f.name)]
    return {composed(f.name): images for f in inner if (images := _image_folder(f))}


def _videos(folder: Path) -> dict[str, Path]:
    return by_stem(f for f in listed(folder) if f.is_file() and f.suffix.lower() in VIDEO_SUFFIXES)


def _image_folder(folder: Path) -> Path | None:
    """Return the folder that holds a camera's or a frame's images: its own, the `images` folder in
    it or another one of colours, or None.
    """
    for place in (folder, *(folder / name for name in _COLORS)):
        if place.is_dir() and images_in(place):
            return place
    return None

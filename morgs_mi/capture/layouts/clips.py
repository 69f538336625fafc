"""Search for each camera's clip in a capture folder.

A clip is a video file, a folder of numbered images, or a list of image files (one per frame). Clips are stored per
camera or per frame; cameras are ordered numerically, cam_2 before cam_10:

- per camera: ``cam01.mp4``, ``cam01/0000.png`` or ``cam01/images/0000.png``, in the capture or in a folder of it
  (``videos/cam01.mp4``, ``images/cam01/0000.png``). Of several clips of one name the lossless one in ``frames/``
  takes precedence, then a video, then a folder; clips in the capture itself take precedence over those in a folder;
- per frame: ``0000/cam01.png`` or ``0000/images/cam01.png``, with the same cameras in every folder;
- photos: ``cam01.png`` or ``images/cam01.png``, one image per camera.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path, PurePosixPath

from morgs_mi.io.video import IMAGE_SUFFIXES, VIDEO_SUFFIXES, natural_key, numbering_gap

__all__ = [
    "EXAMPLE",
    "check_frames",
    "clip_of_camera",
    "clips_by_camera",
    "clips_by_frame",
    "names_without",
    "photos",
    "view_of_image",
]

EXAMPLE = "one folder per camera: cam01/0000.png, cam01/0001.png, ..., cam02/0000.png, cam02/0001.png, ..."
"""The layout of a recording in images, for messages."""

# Folders without clips, and folders with images that do not belong to a camera.
_NOT_CLIPS = {"sparse", "truth", "masks", "seg"}
# Nerfstudio writes downscaled copies to `images_2`, `images_4`, ...
_NOT_CAMERAS = re.compile(rf"{'|'.join(_NOT_CLIPS)}|frames|images(_[0-9]+)?|\..*")


def clips_by_camera(path: Path) -> dict[str, Path]:
    """Return each camera's video or folder of images by the camera's name, in numerical order."""
    inner = [f for f in path.iterdir() if f.is_dir() and f.name not in _NOT_CLIPS and not f.name.startswith(".")]
    found: dict[str, Path] = {}
    # The last clip found for a camera takes precedence.
    for folder in [*sorted(f for f in inner if f.name != "frames"), path]:
        found |= _folders(folder) | {f.stem: f for f in folder.iterdir() if _is_video(f)}
    if (path / "frames").is_dir():
        found |= {f.stem: f for f in (path / "frames").iterdir() if _is_video(f)} | _folders(path / "frames")
    return {name: found[name] for name in sorted(found, key=natural_key)}


def photos(path: Path) -> dict[str, tuple[Path]]:
    """Return the images directly in a capture or its folder `images` as clips of one frame, by their names."""
    folder = _image_folder(path)
    images = sorted(filter(_is_image, folder.iterdir()), key=lambda f: natural_key(f.stem)) if folder else ()
    return {f.stem: (f,) for f in images}


def clips_by_frame(path: Path) -> dict[str, tuple[Path, ...]]:
    """Return each camera's images, one per frame folder, by the camera's name; empty without such folders.

    The first frame determines the cameras; images that are missing in later frames are listed too.
    """
    frames = sorted(_folders(path).values(), key=lambda f: natural_key(str(f)))
    if not frames:
        return {}
    images = sorted((f for f in frames[0].iterdir() if _is_image(f)), key=lambda f: natural_key(f.stem))
    return {f.stem: tuple(folder / f.name for folder in frames) for f in images}


def check_frames(path: Path, clips: Mapping[str, Sequence[Path]]) -> None:
    """Check that the folders of `clips_by_frame` are numbered without gaps.

    Raises:
        ValueError: a number is missing.
    """
    folders = [f.relative_to(path).parts[0] for f in next(iter(clips.values()))]
    if gap := numbering_gap(folders):
        raise ValueError(
            f"{path}: the folders of the frames must be numbered without gaps, got {folders[gap - 1]} followed by "
            f"{folders[gap]}; extract the frames again."
        )


def names_without(path: Path, names: Collection[str], without: Collection[str]) -> list[str]:
    """Return the names of the cameras except `without`; `path` is the capture, for messages.

    Raises:
        ValueError: a camera that is left out does not exist, or all are left out.
    """
    if unknown := [name for name in without if name not in names]:
        raise ValueError(f"{path}: `without` must name cameras of {', '.join(names)}, got {', '.join(unknown)}.")
    kept = [name for name in names if name not in without]
    if without and not kept:
        raise ValueError(f"{path}: `without` must leave at least one camera, got all: {', '.join(names)}.")
    return kept


def view_of_image(views: Collection[str], image: str) -> str | None:
    """Return the camera in `views` to which an image of a calibration belongs, or None.

    It is cam01 for ``cam01.png``, ``cam01.mp4``, ``cam01/0000.png`` and ``cam01/images/0000.png``.
    """
    place = PurePosixPath(image.replace("\\", "/"))
    names = (place.stem, *reversed(place.parts[:-1]))
    return next((name for name in names if name in views), None)


def clip_of_camera(clips: Collection[str], camera: str) -> str | None:
    """Return the clip called `camera`, otherwise the only one with this word in its name (``trial_2-camA``)."""
    if camera in clips:
        return camera
    word = re.compile(rf"(?<![A-Za-z0-9]){re.escape(camera)}(?![A-Za-z0-9])")
    found = [clip for clip in dict.fromkeys(clips) if word.search(clip)]
    return found[0] if len(found) == 1 else None


def _folders(folder: Path) -> dict[str, Path]:
    inner = [f for f in folder.iterdir() if f.is_dir() and not _NOT_CAMERAS.fullmatch(f.name)]
    return {f.name: found for f in inner if (found := _image_folder(f))}


def _image_folder(folder: Path) -> Path | None:
    """Return the folder that holds a camera's or a frame's images: its own or the `images` folder in it, or None."""
    for place in (folder, folder / "images"):
        if place.is_dir() and any(_is_image(f) for f in place.iterdir()):
            return place
    return None


def _is_image(file: Path) -> bool:
    return file.suffix.lower() in IMAGE_SUFFIXES


def _is_video(file: Path) -> bool:
    return file.is_file() and file.suffix.lower() in VIDEO_SUFFIXES

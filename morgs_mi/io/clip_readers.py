"""Readers of the clips of cameras: video files, folders of images, and lists of images."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from morgs_mi.io.images import WHITE, FolderReader, aligned_folders
from morgs_mi.io.video import VideoReader

_LOG = logging.getLogger(__name__)

FrameReader = VideoReader | FolderReader
Clip = Path | tuple[Path, ...]
"""A video file, a folder of images, or a list of image files."""


def open_clips(
    clips: Mapping[str, Clip], gaps: bool = False, white: int | None = None
) -> dict[str, FrameReader]:
    """Return the readers of the clips of cameras; with `gaps`, images may be missing or broken.

    Folders are then aligned by the numbers of their images: a number that only others have is a
    missing image.

    Without `white`, a warning names images of 16 bits that are nearly black, because cameras of 10
    or 12 bits may have written them.

    Args:
        clips: by the names of the cameras.
        gaps: whether images may be missing.
        white: value of white in images of 16 bits; None: the largest.

    Raises:
        FileNotFoundError: a clip is missing, or one of its images.
        ValueError: as `VideoReader.open` and `FolderReader.open`.
    """
    folders = {n: clip for n, clip in clips.items() if isinstance(clip, Path) and clip.is_dir()}
    aligned = aligned_folders(folders) if gaps else {}
    readers = {name: aligned.get(name) or open_frames(clip, gaps) for name, clip in clips.items()}
    if white is not None:
        return {name: replace(reader, white=white) for name, reader in readers.items()}
    largest = max(
        (reader.most for reader in readers.values() if reader.most is not None), default=WHITE
    )
    if largest < WHITE // 4:
        _LOG.warning(
            "%s and the other cameras: the first images have 16 bits but no value above %d and are "
            "nearly black; if white is less than %d, such as 4095 of cameras with 12 bits, set "
            '"white": 4095 in capture.json.',
            next(iter(readers.values())).path,
            largest,
            WHITE,
        )
    return readers


def open_frames(path: str | Path | tuple[Path, ...], gaps: bool = False) -> FrameReader:
    """Return the reader of a video file, a folder of images or a list of images; raises the errors
    of their `open`.

    With `gaps`, images of a list may be missing or broken.
    """
    if isinstance(path, tuple):
        return FolderReader.of_files(path, gaps)
    return FolderReader.open(path) if Path(path).is_dir() else VideoReader.open(path)

"""Content of folders, without the files that operating systems and file servers add, and kinds of
files.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from morgs_mi.platform.checks import composed

VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
EXR_SUFFIX = ".exr"

# In lower case: of macOS and its archives, Windows (thumbnails, settings, bins), Synology, and
# ext4.
_ADDED = {
    *(".ds_store", "__macosx", "icon\r", ".spotlight-v100", ".trashes", ".fseventsd"),
    *("thumbs.db", "ehthumbs.db", "desktop.ini", "$recycle.bin", "system volume information"),
    *("@eadir", "#recycle", "lost+found"),
}


def is_added(name: str) -> bool:
    """Return whether a system adds files or folders of this name, such as macOS's `._cam01.mp4`."""
    return name.startswith("._") or name.lower() in _ADDED


def existing_file(path: str | Path, kind: str, remedy: str = "check the path") -> Path:
    """Return the path of a file.

    Raises:
        FileNotFoundError: there is no such file; the sentence names the kind that was expected.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: expected {kind}, found none; {remedy}.")
    return Path(path)


def listed(folder: str | Path) -> list[Path]:
    """Return the files and folders in a folder that are neither hidden nor added by a system, by
    name.

    Raises:
        OSError: there is no such folder, or it cannot be read.
    """
    files = Path(folder).iterdir()
    return sorted(f for f in files if not (f.name.startswith(".") or is_added(f.name)))


def images_in(folder: str | Path) -> list[Path]:
    """Return the images in a folder by name: those of 8 bits, or EXR files where there is no other
    image.

    Renderers write depth and normals as EXR files beside their images.

    Raises:
        OSError: there is no such folder, or it cannot be read.
    """
    files = listed(folder)
    images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
    return images or [file for file in files if file.suffix.lower() == EXR_SUFFIX]


def by_stem(files: Iterable[Path]) -> dict[str, Path]:
    """Return files by their names without suffix, composed.

    Raises:
        ValueError: two have the same, such as an image and its mask.
    """
    files_by_stem: dict[str, Path] = {}
    for file in files:
        if (other := files_by_stem.setdefault(composed(file.stem), file)) != file:
            raise ValueError(
                f"{file.parent}: expected one file of each name, got {other.name} and {file.name}; "
                "move masks and other copies into a folder outside of it."
            )
    return files_by_stem

"""Protection of captures against outputs in their folders: a new file may be read as a part of the
capture.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from morgs_mi.capture.layouts.reader_registry import READERS

PathLike = TypeVar("PathLike", str, Path)


def check_output(path: PathLike) -> PathLike:
    """Return `path`, the file or folder that is about to be written, if it is outside of all
    captures.

    Links are followed. A capture is a folder with a calibration.

    Raises:
        ValueError: `path` is a capture, or lies in one.
    """
    final = Path(path).resolve()
    for folder in (final, *final.parents):
        if any(reader.find(folder) for reader in READERS):
            raise ValueError(
                f"{path}: expected an output outside of captures, which stay as they were "
                f"recorded, got one in the capture {folder}; choose another place."
            )
    return path

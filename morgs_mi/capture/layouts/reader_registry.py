"""Readers of the supported capture layouts.

A layout is a module with a `READER`, which `READERS` lists. Extras enter theirs; a script appends
its own.
"""

from __future__ import annotations

from pathlib import Path

from morgs_mi.capture.layouts import colmap, nerfstudio, poses_bounds
from morgs_mi.capture.layouts.calibration import Reader, required_clips
from morgs_mi.platform.checks import quantity
from morgs_mi.platform.extras import extra, places
from morgs_mi.platform.files import STREAM

READERS: list[Reader] = [
    colmap.READER,
    nerfstudio.READER,
    *(extra("layouts", name) for name in places("layouts")),
    poses_bounds.READER,
]
"""The readers in order of precedence, for folders with several calibrations. COLMAP's is the most
complete one: it has lenses, principal points and points. `poses_bounds.npy` has none of them."""


def find_reader(path: Path) -> Reader:
    """Return the first reader that finds a calibration in the capture folder `path`.

    Raises:
        FileNotFoundError: there is no calibration.
    """
    if reader := next((reader for reader in READERS if reader.find(path)), None):
        return reader
    if (path / STREAM).is_file():
        raise FileNotFoundError(
            f"{path}: expected a capture, found a fit; `morgs-mi eval {path}` scores it, "
            f"`morgs-mi view {path}` shows it."
        )
    clips = required_clips(path)  # without clips the path itself is likely wrong
    *files, last = [file for reader in READERS for file in reader.files]
    raise FileNotFoundError(
        f"{path}: expected a calibration ({', '.join(files)} or {last}), found none; run "
        "`morgs-mi calibrate` on the folder, which has the clips or photos of "
        f"{quantity(len(clips), 'camera')}."
    )

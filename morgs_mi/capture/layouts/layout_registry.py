"""The supported capture layouts.

A layout is a module that exposes a `LAYOUT`. A module outside of this package appends it to
`LAYOUTS`.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from morgs_mi.capture.layouts import colmap, nerfstudio, poses_bounds
from morgs_mi.capture.layouts.calibration import Layout, required_clips
from morgs_mi.capture.layouts.clips import EXAMPLE
from morgs_mi.core.bounded import read_json
from morgs_mi.core.entries import STUDIO, studio_entry
from morgs_mi.core.fit_names import CAPTURE, STREAM

LAYOUTS: list[Layout] = [
    colmap.LAYOUT,
    nerfstudio.LAYOUT,
    *(studio_entry("layouts", name) for name in STUDIO["layouts"]),
    poses_bounds.LAYOUT,
]
"""The layouts in order of precedence, for folders with several calibrations. COLMAP's is the most
complete one: it has lenses, principal points and points. `poses_bounds.npy` has none of them."""


def find_layout(path: Path) -> Layout:
    """Return the first layout with a calibration in the capture folder `path`.

    Raises:
        FileNotFoundError: there is no calibration.
    """
    if layout := next((layout for layout in LAYOUTS if layout.find(path)), None):
        return layout
    if (path / STREAM).is_file():
        description = None
        with suppress(OSError, ValueError):
            description = read_json(path / CAPTURE)
        capture = description.get("capture") if isinstance(description, dict) else None
        is_named = isinstance(capture, str)
        advice = f", and `morgs-mi info {capture}` describes its capture" if is_named else ""
        raise FileNotFoundError(
            f"{path}: expected a capture, found a fit; `morgs-mi eval {path}` scores it, "
            f"`morgs-mi view {path}` shows it{advice}."
        )
    clips = required_clips(path)  # without clips the path itself is likely wrong
    static = all(isinstance(clip, tuple) for clip in clips.values())
    recording = (
        f" The {len(clips)} photos count as cameras with one frame each; a recording has {EXAMPLE}"
    )
    *files, last = [file for layout in LAYOUTS for file in layout.files]
    raise FileNotFoundError(
        f"{path}: expected a calibration ({', '.join(files)} or {last}), found none; run "
        f"`morgs-mi calibrate` on the folder.{recording if static else ''}"
    )


def layout_called(name: str) -> Layout | None:
    """Return the layout with this name, or None."""
    return next((layout for layout in LAYOUTS if layout.name == name), None)

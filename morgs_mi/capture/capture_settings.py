"""Settings of a capture, in its optional `capture.json`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from morgs_mi.platform.bounded import read_json, warn_unread
from morgs_mi.platform.config import apply_values, check_ranges, types_of

_Readout = Annotated[float, Ge(-1), Le(1)]


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a capture."""

    fps: Annotated[float, Ge(1e-6), Le(1_000_000)] | None = None
    """Frame rate of all clips; None: the rates in their headers."""
    test_view: tuple[int | str, ...] | int | str | None = "auto"
    """Held-out cameras, as for `load_capture`; indices count cameras that are left out."""
    readout: _Readout | dict[str, _Readout] = 0.0
    """Frames from the exposure of an image's first row to the exposure of its last row: of all
    cameras, or those that are not 0 by the cameras' names.
    """
    display_exposure: Annotated[float, Ge(-100), Le(100)] | None = None
    """Stops by which a display brightens EXR files; None: by the first frame."""
    white: Annotated[int, Ge(1), Le(65535)] | None = None
    """Value of white in images of 16 bits; None: the largest."""


def read_settings(path: Path) -> CaptureSettings:
    """Return the settings in a `capture.json`, the default ones without such a file.

    Raises:
        ValueError: the file is not a JSON object, or a setting is not valid.
    """
    content = read_json(path) if path.exists() else {}
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object, got another value; correct it.")
    known = content.keys() & types_of(CaptureSettings)
    if "scene" not in content:  # a synthetic capture describes itself
        warn_unread(path, content.keys() - known)
    settings = apply_values(CaptureSettings(), {name: content[name] for name in known}, path)
    check_ranges(settings, str(path))
    return settings

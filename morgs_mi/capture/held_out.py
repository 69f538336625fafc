"""Selection of the held-out cameras of a capture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from morgs_mi.capture.layouts.calibration import Calibration
from morgs_mi.platform.checks import view_index
from morgs_mi.platform.files import CAPTURE

TestViews = int | str | Sequence[int | str] | None
"""Held-out cameras: an index, a name, several of these, None for none, or "auto"."""
# Number of cameras from which one is held out by default, as in N3DV.
_MANY = 6


def held_out_by(
    path: Path,
    requested: TestViews,
    setting: TestViews,
    every: Calibration,
    subset: Calibration,
) -> tuple[int, ...]:
    """Return the indices of the held-out cameras among the used ones.

    Args:
        path: the capture folder.
        requested: as for `load_capture`; "auto": by the setting.
        setting: of the capture, whose indices count all cameras; "auto": by the layout, or by the
            number of cameras.
        every: all cameras.
        subset: the cameras that are not left out.

    Raises:
        ValueError: a camera is unknown, or none is left for training.
    """
    if requested != "auto":
        return held_out_views(path, requested, subset.names)
    if setting in (None, ()):
        return ()
    names = every.held_out or ()
    if setting != "auto":
        names = [every.names[view] for view in _indices(path / CAPTURE, setting, every.names)]
    names = [name for name in names if name in subset.names]
    if not names and every.held_out != () and len(subset.names) >= _MANY:
        return (0,)
    return held_out_views(path, names, subset.names)


def held_out_views(path: Path, views: TestViews, names: Sequence[str]) -> tuple[int, ...]:
    """Return the ascending indices of cameras that are held out.

    Args:
        path: the capture folder.
        views: an index, a name, several of these, or None for none.
        names: of all cameras.

    Raises:
        ValueError: there is no such camera, or none is left for training.
    """
    indices = _indices(path, views, names)
    if len(indices) == len(names):
        raise ValueError(f"{path}: `test_view` must leave a camera for training, got all.")
    return indices


def _indices(place: Path, views: TestViews, names: Sequence[str]) -> tuple[int, ...]:
    """Return the ascending indices of cameras; `place` is where they were requested."""
    if views is None:
        return ()
    some = views if isinstance(views, list | tuple) else [views]
    return tuple(sorted({view_index(place, "`test_view`", view, names) for view in some}))

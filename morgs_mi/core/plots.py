"""Files of plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from morgs_mi.core.files import atomic_path

_SUFFIXES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")


def check_plot(path: Path) -> None:
    """Check that a plot can be written.

    Raises:
        ValueError: the name has another suffix, or matplotlib is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise ValueError(
            f"{path}: the suffix of a plot must be .png, .jpg, .svg or .pdf, got {suffix!r}; "
            "rename it."
        )
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise ValueError(
            f"{path}: a plot needs the package matplotlib; pip install 'morgs-mi[plots]'."
        ) from None


def save_plot(path: Path, figure: Any, place: str) -> None:
    """Write a figure of matplotlib atomically, in the format of the name.

    Raises:
        OSError: the file cannot be written; its sentence begins with `place`.
    """
    with atomic_path(path, place, parents=True) as partial:
        figure.savefig(partial, format=path.suffix[1:].lower())

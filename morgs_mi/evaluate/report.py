"""What every figure comes with, and how reports show figures: tables for documentation and plots."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["blank_figure", "label_points", "machine", "markdown", "save_figure", "versions"]


def machine() -> dict[str, Any]:
    """Return what the figures were measured on: processor, its number of threads, system and variant."""
    return {
        "processor": _processor(),
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "variant": mi.variant(),
    }


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the libraries that the figures depend on."""
    packages = ("morgs-mi", "mitsuba", "drjit", "numpy", "opencv-contrib-python-headless", "colour-science")
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in packages}


def markdown(titles: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a table in Markdown; the first `left` columns are words, the others numbers."""
    rule = "|---" * left + "|---:" * (len(titles) - left) + "|"
    lines = [f"| {' | '.join(cells)} |" for cells in (titles, *rows)]
    return "\n".join([lines[0], rule, *lines[1:]]) + "\n"


def blank_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display; sizes in inches.

    Raises:
        ValueError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ValueError("plot: expected matplotlib, found none; install it: pip install matplotlib.") from error
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as .png or .svg.

    Raises:
        OSError: it cannot be written.
    """
    figure.savefig(path, dpi=90)


def label_points(
    axis: Any, points: Iterable[tuple[float, float]], names: Iterable[str], shift: tuple[float, float], size: float = 7
) -> None:
    """Write a name beside each point, `shift` typographic points away from it."""
    for name, point in zip(names, points, strict=True):
        axis.annotate(name, point, xytext=shift, textcoords="offset points", fontsize=size)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()

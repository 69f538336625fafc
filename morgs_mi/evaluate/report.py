"""What every figure comes with, and the files that keep it."""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import mitsuba as mi

__all__ = ["finite", "machine", "versions", "write_json"]


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
    packages = ("morgs-mi", "mitsuba", "drjit", "numpy", "opencv-contrib-python-headless")
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in packages}


def write_json(path: str | os.PathLike[str], value: Mapping[str, Any]) -> None:
    """Write `value` as JSON; the file appears whole or not at all. What is not finite becomes null.

    Missing folders are made.

    Raises:
        OSError: the file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps(finite(value), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):  # its folder may be a file
            partial.unlink(missing_ok=True)
        raise OSError(f"write_json(): cannot write {path}: {error.strerror or error}.") from error


def finite(value: Any) -> Any:
    """Return `value` with None for every float in it that JSON cannot express."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()

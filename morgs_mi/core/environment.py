"""Machine and versions, reported with every measurement."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import mitsuba as mi


def machine() -> dict[str, Any]:
    """Return the processor, its number of threads, the system and the Mitsuba variant."""
    return {
        "processor": _processor(),
        "threads": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "variant": mi.variant(),
    }


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the libraries that the figures depend
    on; a library that is on Python's path without being installed has none.
    """
    installed = {package.name: package.version for package in metadata.distributions()}
    packages = (
        "morgs-mi",
        "mitsuba",
        "drjit",
        "numpy",
        "opencv-contrib-python-headless",
        "colour-science",
    )
    return {"python": platform.python_version()} | {
        name: installed.get(name, "not installed") for name in packages
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()

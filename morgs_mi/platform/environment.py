"""Machine and versions, reported with every measurement."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

import mitsuba as mi

from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.threads import usable_cores


def machine() -> JsonObject:
    """Return the processor, its number of threads, the system and the Mitsuba variant."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":")[1] for line in lines if line.startswith("model name")).strip()
    except (OSError, StopIteration):
        name = platform.processor()
    return {
        "processor": name,
        "threads": usable_cores(),
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

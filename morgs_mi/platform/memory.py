"""Memory that is free, and memory that this process holds."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

import drjit as dr

from morgs_mi.platform.checks import require

# Growth of the resident memory after which releasing it pays: the next frame allocates its buffers
# again.
_GROWTH = 1.1
# Fraction of the most active pixels since memory was released, below which it is released again: at
# most once each time that the changes halve.
_SHRINKAGE = 0.5


def check_memory(place: str, needed: float, content: str, remedy: str) -> None:
    """Raise an error unless there is memory for what is about to be computed: Dr.Jit ends the
    process without it.

    Args:
        place: where the error's sentence begins.
        needed: bytes, a lower estimate.
        content: what needs them, for the message, e.g. ``an image of 20000x20000 pixels``.
        remedy: end of the sentence.

    Raises:
        ValueError: fewer bytes are free.
    """
    free = free_memory()
    require(
        needed <= free,
        place,
        f"expected what fits in the {max(free, 0) / 1e9:.1f} GB of free memory",
        f"{content}, which takes about {needed / 1e9:.1f} GB",
        remedy,
    )


def free_memory() -> float:
    """Return the bytes that this process may still use, by the machine and its control group."""
    free = [float("inf")]
    for line in _lines("/proc/meminfo"):
        if line.startswith("MemAvailable:"):
            free.append(1024.0 * int(line.split()[1]))
    (limit,) = _lines("/sys/fs/cgroup/memory.max") or ["max"]
    if limit != "max":
        (usage,) = _lines("/sys/fs/cgroup/memory.current")
        free.append(float(limit) - float(usage))
    return min(free)


def process_memory() -> dict[str, int]:
    """Return the resident memory of this process and its peak so far, ``resident`` and ``peak``,
    bytes; empty where the system does not report them.
    """
    names = {"VmRSS": "resident", "VmHWM": "peak"}
    rows = (line.partition(":") for line in _lines("/proc/self/status"))
    return {names[name]: 1024 * int(size.split()[0]) for name, _, size in rows if name in names}


def release_memory() -> None:
    """Return freed memory, which Dr.Jit and glibc keep for later, to the system."""
    dr.flush_malloc_cache()
    with suppress(AttributeError):  # another C library
        ctypes.pythonapi.malloc_trim(0)  # a handle that exists: a new one is a cycle of objects


class FrameBuffers:
    """Memory that Dr.Jit and glibc keep from frame to frame, for buffers of the same sizes.

    Buffers for more active Gaussians have a new size, and the smaller ones stay allocated. The
    buffers of the first frame, and of frames that changed much more, are not used again.
    """

    def __init__(self) -> None:
        self._resident = 0  # bytes, before memory was last released
        # Fractions of the pixels that were active in the last frame, and the most of all frames
        # since memory was last released.
        self._last_pixels = 0.0
        self._most_pixels = 0.0

    def end_frame(self, frame: int, pixels: float) -> dict[str, int]:
        """Release what the next frame will not use, and return the `process_memory`.

        Args:
            frame: the frame that ends.
            pixels: fraction of its pixels that were active.
        """
        recent_pixels = max(pixels, self._last_pixels)  # videos repeat single frames
        self._last_pixels = pixels
        self._most_pixels = max(pixels, self._most_pixels)
        memory = process_memory()
        resident = memory.get("resident", 0)
        has_grown = resident > _GROWTH * self._resident
        if not has_grown and recent_pixels >= _SHRINKAGE * self._most_pixels:
            return memory
        self._resident = max(resident, self._resident) if frame else 0
        self._most_pixels = recent_pixels
        release_memory()
        return process_memory()


def _lines(path: str) -> list[str]:
    """Return the lines of a system's file; none where it does not exist."""
    try:
        return Path(path).read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):
        return []

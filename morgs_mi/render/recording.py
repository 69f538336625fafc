"""Traced functions that are recorded once: tracing a long loop anew costs several ms a call."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

__all__ = ["recorded"]

_MOST_RECORDINGS = 500


def recorded(function: Callable[..., Any], *static: Any) -> Callable[..., Any]:
    """Return `function` with its first arguments fixed, as a recording of arrays alone; one per variant and `static`.

    What is not an array must be in `static`: Dr.Jit 1.5 tells other arguments apart by a hash in which two booleans can
    cancel. Sizes inside a recording are those of its arguments, or static: `dr.empty` and the like need a static one.
    """
    return _recorded(function, mi.variant(), static)


@cache
def _recorded(function: Callable[..., Any], variant: str, static: tuple[Any, ...]) -> Callable[..., Any]:
    # A long fit meets ever new combinations of sizes; the least used recordings make room.
    recording = dr.freeze(lambda *arrays: function(*static, *arrays), limit=_MOST_RECORDINGS, warn_after=2**31 - 1)

    def call(*arrays: Any) -> Any:
        with _uncollected():
            return recording(*arrays)

    return call


@contextmanager
def _uncollected() -> Iterator[None]:
    """Keep Python from collecting garbage meanwhile, in whichever thread.

    Dr.Jit 1.5 looks at a recording's arguments by Python code while it holds its own lock. Another thread that collects
    arrays just then waits for that lock, but has the interpreter's: both would wait for ever.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()

"""Recordings of traced functions (`dr.freeze`): tracing a long loop again costs several ms per call."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Jit

__all__ = ["recorded"]

_MOST_RECORDINGS = 500


def recorded(function: Callable[..., Jit], *static: Any) -> Callable[..., Jit]:
    """Return a recording of `function` with its first arguments fixed to `static`; the others are Dr.Jit arrays.

    There is one recording per variant and `static`. Arguments that are not arrays must be in `static`: Dr.Jit 1.5
    distinguishes other arguments by a hash in which two booleans can cancel. Sizes inside a recording are those of its
    arguments, or static: `dr.empty` and similar functions need a static size.
    """
    return _recorded(function, mi.variant(), static)


@cache
def _recorded(function: Callable[..., Jit], variant: str, static: tuple[Any, ...]) -> Callable[..., Jit]:
    # A long fit meets new combinations of sizes again and again; the least used recordings are evicted.
    recording = dr.freeze(lambda *arrays: function(*static, *arrays), limit=_MOST_RECORDINGS, warn_after=2**31 - 1)

    def call(*arrays: Jit) -> Jit:
        with _garbage_collection_off():
            return recording(*arrays)

    return call


@contextmanager
def _garbage_collection_off() -> Iterator[None]:
    """Switch off Python's garbage collection in all threads meanwhile.

    Dr.Jit 1.5 inspects a recording's arguments with Python code while it holds its own lock. Another thread that
    collects arrays at that moment waits for that lock while it holds the interpreter's: a deadlock.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()

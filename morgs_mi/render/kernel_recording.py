"""Recordings of traced functions (`dr.freeze`): tracing a long loop again costs several ms per
call.

In Dr.Jit 1.5 recordings are not thread-safe. A recording is replayed into its own memory: two
simultaneous replays end the process. While Dr.Jit inspects the arguments, it holds a lock that
`dr.backward` in another thread waits for, and waits for one that `dr.backward` holds: a deadlock.
Therefore all recordings, and all derivatives that the package computes, hold `render_lock`.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import cache, partial, wraps
from threading import RLock
from typing import Any, ParamSpec, TypeVar

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Jit

P = ParamSpec("P")
R = TypeVar("R")

MOST_RECORDINGS = 500

render_lock = RLock()
"""Lock of the renderer, which a thread may take more than once.

`rasterize` and all functions that fit Gaussians take it. Hold it around `dr.backward` and
`dr.forward` if another thread renders at the same time.
"""

_recordings: list[Any] = []  # every frozen function of this process


def num_recordings() -> int:
    """Return the number of recordings that this process has made."""
    return sum(function.n_recordings for function in _recordings)


def with_render_lock(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function holding `render_lock` while it runs."""

    @wraps(function)
    def locked(*args: P.args, **kwargs: P.kwargs) -> R:
        with render_lock:
            return function(*args, **kwargs)

    return locked


def recorded(function: Callable[..., Jit], *static: object) -> Callable[..., Jit]:
    """Return a recording of `function` with its first arguments fixed to `static`.

    The other arguments are Dr.Jit arrays, or dataclasses of them. There is one recording per
    variant and `static`. Arguments that are not arrays must be in `static`: Dr.Jit 1.5
    distinguishes other arguments by a hash in which two booleans can cancel. Sizes inside a
    recording are its arguments' sizes, or static: `dr.empty` and similar functions need a static
    size.
    """

    def call(*arguments: Jit) -> Jit:
        classes = tuple(type(a) if is_dataclass(a) else None for a in arguments)
        # Dr.Jit holds its own lock while it inspects the arguments. For a dataclass that runs
        # Python code, in which another thread can get the interpreter's lock and then wait for
        # Dr.Jit's: a deadlock.
        plain = [vars(a) if is_dataclass(a) else a for a in arguments]
        with render_lock:
            # An array that is collected while Dr.Jit inspects the arguments waits for Dr.Jit's lock
            # forever.
            collects = gc.isenabled()
            gc.disable()
            try:
                return _recording(function, mi.variant(), static, classes)(*plain)
            finally:
                if collects:
                    gc.enable()

    return call


@cache
def _recording(
    function: Callable[..., Jit],
    variant: str,
    static: tuple[object, ...],
    classes: tuple[type | None, ...],
) -> Callable[..., Jit]:
    # Dr.Jit also inspects the variables of a closure; what is in a `partial` it compares by
    # identity.
    rebuilt = partial(_rebuilt, function, static, classes)
    # A long fit meets new combinations of sizes again and again; the least used recordings are
    # evicted.
    frozen = dr.freeze(lambda *plain: rebuilt(plain), limit=MOST_RECORDINGS, warn_after=2**31 - 1)
    _recordings.append(frozen)
    return frozen


def _rebuilt(
    function: Callable[..., Jit],
    static: tuple[object, ...],
    classes: tuple[type | None, ...],
    plain: tuple[Jit, ...],
) -> Jit:
    """Return the result of `function` for arguments with their dataclasses converted to dicts."""
    return function(*static, *(c(**a) if c else a for a, c in zip(plain, classes, strict=True)))

"""Ctrl-C, SIGTERM and SIGHUP: one exception for all, also where a library has turned it into
another or has swallowed it.

Dr.Jit calls Python from C++, and raises a RuntimeError for whatever such a callback raises. An
interruption is therefore looked for along the causes and contexts of an error. Its traceback refers
to Dr.Jit's arrays. If a garbage collection in another thread freed them, the process could crash.
"""

from __future__ import annotations

import _thread
import gc
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

INTERRUPTED = 130
"""Exit status after an interruption."""
# SIGHUP: the terminal was closed.
_SIGNALS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
_PAUSE = 0.05  # seconds until an interruption that was swallowed is raised again


def is_interruption(error: BaseException) -> bool:
    """Return whether a `KeyboardInterrupt` is an error, or among its causes and contexts."""
    return any(isinstance(link, KeyboardInterrupt) for link in _chain(error))


@contextmanager
def interrupts_raised() -> Iterator[None]:
    """Raise an interruption as `KeyboardInterrupt`, whatever a library has made of it; also a
    decorator.

    The variables of the functions that were interrupted are released in this thread.
    """
    try:
        yield
    except BaseException as error:
        if not is_interruption(error):
            raise
        _release(error)
        if isinstance(error, KeyboardInterrupt):
            raise
        raise KeyboardInterrupt from None


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise `KeyboardInterrupt` at SIGTERM and SIGHUP as at Ctrl-C, and again where a destructor or
    a callback swallows it.

    In a thread that is not the main one, signals cannot be handled, and nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hook = sys.unraisablehook
    timers: list[threading.Timer] = []

    def repeat(problem: Any) -> None:
        """Repeat an interruption that Python is about to print and to ignore."""
        if not isinstance(problem.exc_value, KeyboardInterrupt):
            hook(problem)
            return
        timers.append(threading.Timer(_PAUSE, _interrupt_main_thread))
        timers[-1].start()

    with _handle_signals(signal.default_int_handler):
        try:
            sys.unraisablehook = repeat
            yield
            if any(timer.is_alive() for timer in timers):  # the block ended before the repetition
                raise KeyboardInterrupt
        finally:
            sys.unraisablehook = hook
            for timer in timers:
                timer.cancel()


@contextmanager
def postponed() -> Iterator[None]:
    """Raise an interruption within the block at its end, and let the processes that it starts
    ignore Ctrl-C: their library would print the tracebacks of all its tasks.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers: list[int] = []
    block = getattr(signal, "pthread_sigmask", lambda *_: None)  # not on Windows
    with _handle_signals(lambda number, _: numbers.append(number)):
        block(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            yield
        finally:
            block(signal.SIG_UNBLOCK, [signal.SIGINT])
    if numbers:
        raise KeyboardInterrupt


@contextmanager
def _handle_signals(handle: Callable[[int, FrameType | None], Any]) -> Iterator[None]:
    """Handle the signals by a function, except those that are ignored: a shell lets the processes
    that it starts in the background ignore Ctrl-C, and nohup all its processes SIGHUP.
    """
    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    try:
        for number, handler in handlers.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, handle)
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _release(error: BaseException) -> None:
    """Release the variables of the functions that an error has left, in this thread alone."""
    collects = gc.isenabled()
    gc.disable()
    for link in _chain(error):
        traceback.clear_frames(link.__traceback__)
    gc.collect()
    if collects:
        gc.enable()


def _chain(error: BaseException) -> list[BaseException]:
    """Return an error with all its causes, contexts and members."""
    links = [error]
    for link in links:  # which grows
        members = link.exceptions if isinstance(link, BaseExceptionGroup) else ()
        for other in (link.__cause__, link.__context__, *members):
            if other is not None and other not in links:
                links.append(other)
    return links


def _interrupt_main_thread() -> None:
    """Interrupt the main thread, also in a system call."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    else:
        _thread.interrupt_main()

"""COLMAP's Python library, imported without its signal handlers."""

from __future__ import annotations

import signal
import threading
from importlib import import_module
from typing import Any


def import_pycolmap() -> Any:
    """Return the module pycolmap, and restore the signal handlers of Ctrl-C and SIGTERM after its
    import.

    The logging library of pycolmap installs a handler for SIGTERM that prints a stack trace and
    aborts the process.
    """
    pycolmap = import_module("pycolmap")
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if (handler := signal.getsignal(number)) is not None:
                signal.signal(number, handler)
    return pycolmap

"""COLMAP's Python library, imported without its signal handlers."""

from __future__ import annotations

import signal
import threading
from importlib import import_module
from typing import Any


def import_pycolmap() -> Any:
    """Import pycolmap, and set the handlers of Ctrl-C and SIGTERM again.

    Its logging library replaces that of SIGTERM by one that prints a trace and aborts the process.
    """
    pycolmap = import_module("pycolmap")
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if (handler := signal.getsignal(number)) is not None:
                signal.signal(number, handler)
    return pycolmap

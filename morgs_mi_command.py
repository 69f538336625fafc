"""Entry point of the command line: it prepares the process, and then imports the package.

It is beside the package because importing that takes time, in which Ctrl-C must end the process
without a traceback. Until then, this module needs the standard library only.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from types import FrameType

_INTERRUPTED = 130  # exit status after an interruption
# SIGHUP: the terminal was closed.
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


def main() -> int:
    """Run `morgs-mi` and return its exit status."""
    _prepare()
    try:
        import morgs_mi  # noqa: F401
    except RuntimeError as error:  # there is no usable LLVM
        sys.exit(str(error))
    from morgs_mi.cli.main import main as run

    return run()


def _prepare() -> None:
    """Prepare this process for the command line.

    Until `interruptible` of `morgs_mi.platform.interrupts`, and after it, an interruption ends the
    process at once: a half-imported library raises anything. A standard stream that is closed
    becomes the null device; otherwise the next file that is opened would take its place, and
    receive what libraries print. The processes that it starts import no module of the current
    folder, which may have been downloaded.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    for stream in ("stdin", "stdout", "stderr"):
        if getattr(sys, stream) is None:
            setattr(sys, stream, open(os.devnull, "r" if stream == "stdin" else "w"))  # noqa: SIM115
    for name in _SIGNALS:
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    with suppress(OSError):
        os.write(2, b"Interrupted.\n")
    os._exit(_INTERRUPTED)

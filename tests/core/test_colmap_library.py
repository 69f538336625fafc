"""The import of pycolmap, whose logging library handles signals."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import signal, time
from morgs_mi.core.colmap_library import import_pycolmap
from morgs_mi.core.interrupts import interruptible

with interruptible():
    import_pycolmap()
    try:
        signal.raise_signal(signal.SIGTERM)
        time.sleep(1)
    except KeyboardInterrupt:
        print("interrupted")
"""


def test_import_pycolmap__keeps_the_handler_of_sigterm():
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "interrupted\n", "")

"""The import of pycolmap, whose logging library handles signals."""

from pathlib import Path

import morgs_mi
from tests.scenes.programs import run_script

SCRIPT = """
import signal, time
from morgs_mi.extras.calibration.calibrate import import_pycolmap
from morgs_mi.platform.interrupts import interruptible

with interruptible():
    import_pycolmap()
    try:
        signal.raise_signal(signal.SIGTERM)
        time.sleep(1)
    except KeyboardInterrupt:
        print("interrupted")
"""


def test_import_pycolmap__keeps_the_handler_of_sigterm():
    result = run_script(SCRIPT, timeout=120)
    assert (result.returncode, result.stdout, result.stderr) == (0, "interrupted\n", "")


def test_import_pycolmap__is_called_by_the_calibration_alone():
    package = Path(morgs_mi.__file__).parent
    users = [path for path in package.rglob("*.py") if "pycolmap()" in path.read_text("utf-8")]
    assert {path.parent for path in users} == {package / "extras/calibration"}

"""Dynamic Gaussian splatting for Mitsuba 3."""

import sys
from pathlib import Path

import lazy_loader

from morgs_mi.core.interrupts import begin_command
from morgs_mi.core.llvm import ensure_llvm

begin_command()
# Before anything imports Dr.Jit, which looks for LLVM at that moment.
try:
    ensure_llvm()
except RuntimeError as error:
    if Path(sys.argv[0]).stem in ("morgs-mi", "-m"):  # the command line prints no traceback
        sys.exit(str(error))
    raise

import morgs_mi.gaussian_integrator  # noqa: E402, F401  (registers the integrators)

# The public names are in __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

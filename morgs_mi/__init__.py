"""Dynamic Gaussian splatting for Mitsuba 3."""

from typing import Any

import lazy_loader

from morgs_mi.platform.llvm import ensure_llvm

# Before anything imports Dr.Jit, which looks for LLVM at that moment.
ensure_llvm()

import morgs_mi.gaussian_integrator  # noqa: E402, F401  (registers the integrators)

# The public names are in __init__.pyi.
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Return a public name, whose module is imported."""
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith(f"{__name__}.extras"):
            raise
        raise ImportError(
            f"morgs_mi.{name}: expected the folder {error.name}, found none; install morgs_mi with "
            "all folders of extras."
        ) from None

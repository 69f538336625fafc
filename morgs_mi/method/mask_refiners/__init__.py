"""Refiners of motion masks.

Every module of this package is imported here. A new one only has to register itself (see `mask_registry`).
"""

from importlib import import_module
from pkgutil import iter_modules

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

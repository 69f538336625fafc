"""Refiners of motion masks.

Every module of this package is imported here. A new one only has to register itself (see
`mask_registry`).
"""

from importlib import import_module
from pkgutil import iter_modules

from morgs_mi.core.extras import extra_function, places
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
for _name in places("mask refiners"):
    MASK_REFINERS.register(*_name.split(":"))(extra_function("mask refiners", _name))

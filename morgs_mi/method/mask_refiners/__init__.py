"""Refiners of motion masks.

Every module of this package is imported here. A new one only has to register itself (see
`mask_registry`).
"""

from functools import partial
from importlib import import_module
from pkgutil import iter_modules

from morgs_mi.core.entries import studio_entry
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
MASK_REFINERS.register_entry(
    "sam2", "ENCODER.onnx,DECODER.onnx", partial(studio_entry, "mask refiners", "sam2")
)

"""Refiners of motion masks.

Every module of this package is imported here. A new one only has to register itself (see
`mask_registry`).
"""

from importlib import import_module
from pkgutil import iter_modules

from morgs_mi.core.entries import studio_function
from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
MASK_REFINERS.register("sam2", "ENCODER.onnx,DECODER.onnx")(
    studio_function("mask refiners", "sam2")
)

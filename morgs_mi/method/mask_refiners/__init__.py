"""Refiners of motion masks.

Every module of this package is imported here. A new one only has to register itself (see
`mask_registry`).
"""

from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS

MASK_REFINERS.fill(__name__, __path__, "mask refiners")

"""Names for Dr.Jit's types.

The class of a name depends on the Mitsuba variant, which is set while the program runs. It cannot
be checked statically: the names describe arguments and results.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

Float: TypeAlias = Any
"""`mi.Float`, a differentiable float32 array [N]."""
Int32: TypeAlias = Any
"""`mi.Int32` [N]."""
UInt32: TypeAlias = Any
"""`mi.UInt32` [N]."""
Bool: TypeAlias = Any
"""`mi.Bool` [N]."""
Tensor: TypeAlias = Any
"""`mi.TensorXf`, a differentiable float32 tensor."""
Jit: TypeAlias = Any
"""Any Dr.Jit array, or nested vectors, tuples and lists of them."""
Tensors: TypeAlias = Mapping[str, Tensor]
"""Tensors by name, such as parameters, losses or channels."""
Arrays: TypeAlias = Mapping[str, np.ndarray]
"""NumPy arrays by name."""

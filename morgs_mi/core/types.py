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
Point2f: TypeAlias = Jit
"""`mi.Point2f` [N]."""
Point3f: TypeAlias = Jit
"""`mi.Point3f` [N]."""
Vector2f: TypeAlias = Jit
"""`mi.Vector2f` [N]."""
Vector3f: TypeAlias = Jit
"""`mi.Vector3f` [N]."""
Vector4f: TypeAlias = Jit
"""`mi.Vector4f` [N]."""
Color3f: TypeAlias = Jit
"""`mi.Color3f` [N]."""
Matrix3f: TypeAlias = Jit
"""`mi.Matrix3f` [N]."""
Point2u: TypeAlias = Jit
"""`mi.Point2u` [N], places of pixels or blocks."""
Point3d: TypeAlias = Jit
"""`mi.Point3d` [N], in double precision."""
Vector3d: TypeAlias = Jit
"""`mi.Vector3d` [N], in double precision."""
Matrix3d: TypeAlias = Jit
"""`mi.Matrix3f64` [N], in double precision."""
Tensors: TypeAlias = Mapping[str, Tensor]
"""Tensors by name, such as parameters, losses or channels."""
Arrays: TypeAlias = Mapping[str, np.ndarray]
"""NumPy arrays by name."""
SceneDict: TypeAlias = dict[str, Any]
"""Description of a scene, or of a part of one, for `mi.load_dict`."""

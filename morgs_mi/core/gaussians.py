"""The `Gaussians` value: what a scene is made of.

A bare name (`scales`, `opacities`, `confidence`) is activated, what the optimiser holds says so in its name
(`log_scales`, `logit_opacities`, `logit_confidence`). N is the number of Gaussians, K = (degree + 1)^2.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.attributes import ATTRIBUTES, BY_ACTIVATED_NAME, sigmoid

__all__ = ["ActivatedGaussians", "Gaussians", "repeat_each", "tensor_rows"]


class ActivatedGaussians(Protocol):
    """What the renderer reads: activated attributes as Dr.Jit tensors."""

    @property
    def means(self) -> Any:
        """Centres [N, 3], world units."""
        ...

    @property
    def scales(self) -> Any:
        """Standard deviations [N, 3], world units."""
        ...

    @property
    def quats(self) -> Any:
        """Rotations [N, 4], wxyz, not necessarily unit."""
        ...

    @property
    def opacities(self) -> Any:
        """Opacities [N] in [0, 1]."""
        ...

    @property
    def sh_coeffs(self) -> Any:
        """Spherical harmonics [N, K, 3] of the display-referred colour."""
        ...

    @property
    def motion(self) -> Any:
        """Displacement [N, 3] since the last frame, world units, or None."""
        ...

    @property
    def confidence(self) -> Any:
        """Motion confidence [N] in [0, 1], or None."""
        ...

    def rows(self, name: str, index: Any) -> list[Any]:
        """Return an attribute of the Gaussians at `index`, as `tensor_rows` does."""
        ...


def tensor_rows(tensor: Any, index: Any) -> list[Any]:
    """Return rows of a tensor [N, ...], one Dr.Jit float [M] per number of a row, differentiable.

    Args:
        tensor: D numbers in each of N rows.
        index: UInt32 [M], none of them twice: every element is read once, so that the adjoint needs no atomics.
    """
    size, mode = int(dr.prod(tensor.shape[1:])), dr.ReduceMode.NoConflicts
    if size in (3, 4):  # four at a time are read as one packet
        return list(dr.gather(mi.Vector3f if size == 3 else mi.Vector4f, tensor.array, index, mode=mode))
    return [dr.gather(mi.Float, tensor.array, index * size + k, mode=mode) for k in range(size)]


def repeat_each(x: Any, count: int) -> Any:
    """Return every element of a float [N] `count` times in a row, [N * count].

    Dr.Jit's own `repeat` gathers, so its adjoint adds atomically, in an order of its own; this one sums blocks.
    """
    return dr.custom(_Repeated, x, count) if count > 1 else x


class _Repeated(dr.CustomOp):
    def eval(self, x: Any, count: int) -> Any:
        self.count = count
        return dr.repeat(x, count)

    def backward(self) -> None:
        self.set_grad_in("x", dr.block_sum(self.grad_out(), self.count))

    def forward(self) -> None:
        self.set_grad_out(dr.repeat(self.grad_in("x"), self.count))

    def name(self) -> str:
        return "morgs_mi.repeated"


def _aligned_tensor(value: Any) -> Any:
    """Return a NumPy array as a float tensor in memory of Dr.Jit's own.

    Dr.Jit borrows NumPy's memory where it can. Packets of floats cannot be read from it unless it happens to
    be aligned, and kernels would be compiled for both cases; multiplying by an opaque one makes a copy.
    """
    tensor = mi.TensorXf(np.ascontiguousarray(value, dtype=np.float32))
    if tensor.array.shape[0]:
        tensor = tensor * dr.opaque(mi.Float, 1)
        dr.eval(tensor)
    return tensor


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as raw (optimisable) Dr.Jit tensors of the active Mitsuba variant.

    NumPy arrays are converted. Quaternions are wxyz and need not be unit.

    Attributes:
        means: centres [N, 3], world units.
        log_scales: logarithms of the standard deviations [N, 3].
        quats: rotations [N, 4], wxyz.
        logit_opacities: [N].
        sh_coeffs: [N, K, 3] with K = (degree + 1)^2; colour = max(0.5 + SH(mean - camera), 0) as in 3DGS.
        motion: displacement since the last frame [N, 3] in world units, or None.
        logit_confidence: motion confidence [N] before the sigmoid, or None.
        offset: the learned part of that displacement [N, 3] beside the one that flow guides (eq. 8), or None.

    Raises:
        ValueError: a shape that does not agree with `means`, or K that is no square of 1 to 4.
    """

    means: Any
    log_scales: Any
    quats: Any
    logit_opacities: Any
    sh_coeffs: Any
    motion: Any = None
    logit_confidence: Any = None
    offset: Any = None

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if value is not None and not dr.is_tensor_v(value):
                object.__setattr__(self, f.name, _aligned_tensor(value))
        N = len(self)
        for attribute in ATTRIBUTES:
            if attribute.activated_name == "sh_coeffs":  # two rows in one tensor, checked below
                continue
            value, tail = getattr(self, attribute.name), attribute.shape
            if value is not None and tuple(value.shape) != (N, *tail):
                expected = ", ".join(["N", *map(str, tail)])
                raise ValueError(
                    f"Gaussians(): `{attribute.name}` must be [{expected}] with N={N}, got {tuple(value.shape)}; "
                    "all attributes describe the same Gaussians."
                )
        shape = tuple(self.sh_coeffs.shape)
        if len(shape) != 3 or shape[0] != N or shape[2] != 3 or shape[1] not in (1, 4, 9, 16):
            raise ValueError(
                f"Gaussians(): `sh_coeffs` must be [N, K, 3] with N={N} and K in 1, 4, 9, 16, got {shape}; "
                "K is (degree + 1)^2 for degree 0 to 3."
            )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @classmethod
    def from_activated(
        cls, means: Any, scales: Any, quats: Any, opacities: Any, sh_coeffs: Any, **more: Any
    ) -> Gaussians:
        """Build from activated NumPy arrays: `scales` [N, 3] > 0 and `opacities` [N] in [0, 1].

        Opacities are kept 1e-6 away from 0 and 1, where the logit is infinite.
        """
        opacities = np.clip(np.asarray(opacities, np.float64), 1e-6, 1 - 1e-6)
        log_scales = np.log(np.maximum(np.asarray(scales, np.float64), 1e-30))
        logits = np.log(opacities / (1 - opacities))
        return cls(means, log_scales, quats, logits, sh_coeffs, **more)

    @property
    def scales(self) -> Any:
        """Standard deviations [N, 3]."""
        return dr.exp(self.log_scales)

    @property
    def opacities(self) -> Any:
        """Opacities [N] in (0, 1)."""
        return sigmoid(self.logit_opacities)

    @property
    def confidence(self) -> Any:
        """Motion confidence [N] in (0, 1), or None."""
        return None if self.logit_confidence is None else sigmoid(self.logit_confidence)

    def __getattr__(self, name: str) -> Any:
        """Return the activated value of an attribute of the table that has no property of its own, or None."""
        attribute = BY_ACTIVATED_NAME.get(name)
        if attribute is None or attribute.name == name:
            raise AttributeError(
                f"Gaussians has no attribute {name!r}; see morgs_mi.core.attributes for those that exist."
            )
        value = getattr(self, attribute.name)
        return None if value is None else attribute.activation.function(value)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return round(int(self.sh_coeffs.shape[1]) ** 0.5) - 1

    def items(self) -> dict[str, Any]:
        """Return the raw attributes that are present, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}

    def numpy(self) -> dict[str, np.ndarray]:
        """Return the raw attributes that are present as NumPy arrays."""
        return {name: np.asarray(dr.detach(value)) for name, value in self.items().items()}

    def detached(self) -> Gaussians:
        """Return the same values cut off from the gradient graph."""
        return replace(self, **{name: dr.detach(value) for name, value in self.items().items()})

    def rows(self, name: str, index: Any) -> list[Any]:
        """Return an activated attribute of the Gaussians at `index` (see `tensor_rows`): read first, then activated."""
        if name == "sh_coeffs":
            return tensor_rows(self.sh_coeffs, index)
        attribute = BY_ACTIVATED_NAME[name]
        return [attribute.activation.function(column) for column in tensor_rows(getattr(self, attribute.name), index)]

    def select(self, index: Any) -> Gaussians:
        """Return the Gaussians at `index` [M] (integers, or a mask [N]); gradients are not carried."""
        return Gaussians(**{name: value[index] for name, value in self.numpy().items()})

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        """Return all Gaussians of `parts` in order; every part must carry the same attributes."""
        columns = [part.numpy() for part in parts]
        if any(column.keys() != columns[0].keys() for column in columns):
            raise ValueError(
                "Gaussians.concatenate(): all parts must carry the same attributes, got "
                f"{[sorted(column) for column in columns]}; drop or add `motion`, `offset` and `logit_confidence`."
            )
        return Gaussians(**{k: np.concatenate([column[k] for column in columns]) for k in columns[0]})

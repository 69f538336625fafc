"""The `Gaussians` value.

A bare name (`scales`, `opacities`, `confidence`) is activated; what the optimiser holds has the
inverse of its activation in its name (`log_scales`, `logit_opacities`, `logit_confidence`). N is
the number of Gaussians, K = (degree + 1)^2 the number of spherical harmonics (SH).
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields, replace
from typing import Protocol, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from morgs_mi.core.arrays import concatenated, float_tensor, from_numpy, rows_of
from morgs_mi.core.attributes import (
    ATTRIBUTES,
    BY_ACTIVATED_NAME,
    BY_NAME,
    EXP,
    SIGMOID,
    sigmoid,
)
from morgs_mi.core.types import Arrays, Bool, Float, Tensor, Tensors, UInt32
from morgs_mi.platform.checks import numbers, require

# Numbers up to which a sum is read by another kernel instead of made by one of its own.
_MOST_READ = 4


class ActivatedGaussians(Protocol):
    """Activated attributes as Dr.Jit tensors, which the renderer reads."""

    @property
    def means(self) -> Tensor:
        """Centres [N, 3], world units."""
        ...

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N, 3], world units."""
        ...

    @property
    def quats(self) -> Tensor:
        """Rotations [N, 4], wxyz, not necessarily unit."""
        ...

    @property
    def opacities(self) -> Tensor:
        """Opacities [N] in [0, 1]."""
        ...

    @property
    def sh_coeffs(self) -> Tensor:
        """Spherical harmonics [N, K, 3] of the display-referred colour."""
        ...

    @property
    def motion(self) -> Tensor:
        """Displacement [N, 3] since the last frame, world units, or None."""
        ...

    @property
    def confidence(self) -> Tensor:
        """Motion confidence [N] in [0, 1], or None."""
        ...

    def rows(self, name: str, index: UInt32) -> list[Float]:
        """Return an attribute of the Gaussians at `index`, as `tensor_rows` does."""
        ...


def require_some(place: str, gaussians: ActivatedGaussians, remedy: str) -> None:
    """Raise an error unless there is at least one Gaussian.

    Raises:
        ValueError: there is none, in a sentence that begins with `place` and ends with `remedy`.
    """
    require(
        hasattr(gaussians, "means") and int(gaussians.means.shape[0]),
        place,
        "`gaussians` must be at least one Gaussian",
        f"a {type(gaussians).__name__} without any",
        remedy,
    )


def displaced(gaussians: Gaussians, displacement: np.ndarray) -> Gaussians:
    """Return N Gaussians that have moved by displacements [N, 3], world units, in a frame."""
    return replace(
        gaussians,
        means=np.asarray(gaussians.means) + displacement,
        motion=displacement,
        offset=None,
    )


def at_rest(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with a motion and an offset of zero."""
    zero = dr.zeros(mi.TensorXf, (len(gaussians), 3))
    return replace(gaussians, motion=zero, offset=zero)


def tensor_rows(tensor: Tensor, index: UInt32) -> list[Float]:
    """Return rows of a tensor [N, ...], one Dr.Jit float [M] per number of a row, differentiable.

    Args:
        tensor: D numbers in each of N rows.
        index: UInt32 [M], none of them twice.
    """
    return read_columns(tensor.array, index, int(dr.prod(tensor.shape[1:])))


def read_columns(array: Float, index: UInt32, size: int, active: Bool | bool = True) -> list[Float]:
    """Return rows of `size` numbers of a flat array, one float [M] per number, differentiable.

    Args:
        array: the rows, one after the other.
        index: of the rows [M], none of them twice.
        size: numbers in a row.
        active: lanes that read; the others get zeros.
    """
    return dr.custom(_Columns, array, index, size, active)


class _Columns(dr.CustomOp):
    """Without it, the adjoint of each gather adds one lane after the other."""

    def eval(self, array: Float, index: UInt32, size: int, active: Bool | bool) -> list[Float]:
        self.width = dr.width(array)
        self.index = index
        self.size = size
        self.active = active
        return self._read(array)

    def _read(self, array: Float) -> list[Float]:
        # Not in packets: memory that is borrowed from NumPy may not be aligned to them.
        return [
            dr.gather(mi.Float, array, self.index * self.size + k, self.active)
            for k in range(self.size)
        ]

    def backward(self) -> None:
        grads = cast(list[Float], self.grad_out())
        # No row is read twice: as many as there are means all of them.
        is_whole = self.active is True and dr.width(self.index) * self.size == self.width
        total = (dr.empty if is_whole else dr.zeros)(mi.Float, self.width)
        kind, step = (mi.Vector4f, 4) if self.size % 4 == 0 else (mi.Vector1f, 1)
        count = self.size // step
        for j in range(count):
            packet = kind(*grads[step * j : step * (j + 1)])
            place = self.index * count + j
            dr.scatter(total, packet, place, self.active, mode=dr.ReduceMode.NoConflicts)
        self.set_grad_in("array", total)

    def forward(self) -> None:
        self.set_grad_out(self._read(cast(Float, self.grad_in("array"))))


def repeat_each(x: Float, count: int) -> Float:
    """Return every element of a float [N] `count` times in a row, [N * count].

    The adjoint of Dr.Jit's own `repeat` adds atomically, in no fixed order; this one sums blocks.
    """
    return dr.custom(_RepeatEach, x, count) if count > 1 else x


class _RepeatEach(dr.CustomOp):
    def eval(self, x: Float, count: int) -> Float:
        self.count = count
        return dr.repeat(x, count)

    def backward(self) -> None:
        grads = cast(Float, self.grad_out())
        if self.count > _MOST_READ:
            self.set_grad_in("x", dr.block_sum(grads, self.count))
            return
        # Read by the kernel that needs the sum, and added in the order of `dr.block_sum`.
        first = dr.arange(mi.UInt32, dr.width(grads) // self.count) * self.count
        parts = [dr.gather(mi.Float, grads, first + k) for k in range(self.count)]
        if self.count == _MOST_READ:
            parts = [parts[0] + parts[2], parts[1] + parts[3]]
        self.set_grad_in("x", sum(parts[1:], parts[0]))

    def forward(self) -> None:
        self.set_grad_out(dr.repeat(self.grad_in("x"), self.count))


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians as raw (optimisable) Dr.Jit tensors of the active Mitsuba variant.

    NumPy arrays are copied, Dr.Jit tensors are shared. Quaternions are wxyz and need not be unit.

    Attributes:
        means: centres [N, 3], world units.
        log_scales: logarithms of the standard deviations [N, 3].
        quats: rotations [N, 4], wxyz.
        logit_opacities: [N].
        sh_coeffs: [N, K, 3] with K = (degree + 1)^2; colour = max(0.5 + SH(mean - camera), 0) as in
            3DGS.
        motion: displacement since the last frame [N, 3] in world units, or None.
        logit_confidence: motion confidence [N] before the sigmoid, or None.
        offset: the learned part of that displacement [N, 3], beside the part that is guided by flow
            (eq. 8), or None.

    Example:
        >>> arrays = (means, scales, quats, opacities, sh_coeffs)
        >>> gaussians = morgs_mi.Gaussians.from_activated(*arrays)
        >>> image = morgs_mi.rasterize(gaussians, camera).color

    Raises:
        ValueError: a shape that does not agree with `means`, a K that is not 1, 4, 9 or 16, or
            other values than numbers.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    sh_coeffs: Tensor
    motion: Tensor | None = None
    logit_confidence: Tensor | None = None
    offset: Tensor | None = None

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if value is not None or f.default is MISSING:
                object.__setattr__(self, f.name, float_tensor("Gaussians()", f.name, value))
        N = self.means.shape[0] if len(self.means.shape) else 0
        shapes = {a.name: [(N, *a.shape)] for a in ATTRIBUTES if a.activated_name != "sh_coeffs"}
        shapes["sh_coeffs"] = [(N, K, 3) for K in (1, 4, 9, 16)]
        for name, allowed in shapes.items():
            value = getattr(self, name)
            require(
                value is None or tuple(value.shape) in allowed,
                "Gaussians()",
                f"`{name}` must be {' or '.join(str(list(shape)) for shape in allowed)}",
                () if value is None else list(value.shape),
                "all attributes describe the same Gaussians",
            )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        more = [name for name in self.items() if name in ("motion", "logit_confidence", "offset")]
        parts = [f"N={len(self)}", f"SH degree {self.sh_degree}", f"box of {self.size}", *more]
        return f"Gaussians({', '.join(parts)})"

    @property
    def size(self) -> str:
        """Sides of the box around the means, world units, such as ``2 x 1 x 0.25``; 0 of none."""
        if not len(self):
            return "0"
        sides = np.ptp(np.asarray(dr.detach(self.means)), axis=0)
        return " x ".join(f"{side:.3g}" for side in sides)

    @classmethod
    def from_activated(
        cls,
        means: ArrayLike,
        scales: ArrayLike,
        quats: ArrayLike,
        opacities: ArrayLike,
        sh_coeffs: ArrayLike,
        **more: ArrayLike,
    ) -> Gaussians:
        """Return Gaussians with activated NumPy arrays: `scales` [N, 3] >= 0 and `opacities` [N] in
        [0, 1].

        Scales are at least 1e-30, opacities are clipped to [1e-6, 1 - 1e-6]: the logarithm of 0 and
        the logits of 0 and 1 are infinite.

        Raises:
            ValueError: a scale or an opacity out of these ranges, and as for `Gaussians`.
        """
        place = "Gaussians.from_activated()"
        for name, values in (("scales", scales), ("opacities", opacities)):
            require(
                not dr.grad_enabled(values),
                place,
                f"`{name}` must not be attached to gradients",
                "a Dr.Jit array that is",
                "pass Gaussians(log_scales=dr.log(scales), ...)",
            )
        opacities = numbers(place, "opacities", opacities)
        scales = numbers(place, "scales", scales)
        for name, values, high in (("scales", scales, np.inf), ("opacities", opacities, 1)):
            bad = np.argwhere((values < 0) | (values > high))
            require(
                not len(bad),
                place,
                f"`{name}` must be in [0, {high}]",
                f"{values[tuple(bad[0])]} at {bad[0].tolist()}" if len(bad) else "",
                "pass activated values, not logarithms or logits",
            )
        return cls(means, EXP.inverse(scales), quats, SIGMOID.inverse(opacities), sh_coeffs, **more)

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N, 3]."""
        return dr.exp(self.log_scales)

    @property
    def opacities(self) -> Tensor:
        """Opacities [N] in (0, 1)."""
        return sigmoid(self.logit_opacities)

    @property
    def confidence(self) -> Tensor:
        """Motion confidence [N] in (0, 1), or None."""
        return None if self.logit_confidence is None else sigmoid(self.logit_confidence)

    def __getattr__(self, name: str) -> Tensor | None:
        """Return the activated value of an attribute of the table that has no property of its own,
        or None.
        """
        attribute = BY_ACTIVATED_NAME.get(name)
        if attribute is None or attribute.name == name:
            raise AttributeError(
                f"Gaussians has no attribute {name!r}; see morgs_mi.core.attributes for those "
                "that exist."
            )
        value = getattr(self, attribute.name)
        return None if value is None else attribute.activation.function(value)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return round(int(self.sh_coeffs.shape[1]) ** 0.5) - 1

    def parameters(self) -> Tensors:
        """Return the raw attributes that are present, by the names of the attribute table (SH in
        two parts).
        """
        sh_dc, sh_rest = split_sh(self.sh_coeffs)
        values = {**self.items(), "sh_dc": sh_dc, "sh_rest": sh_rest}
        return {a.name: values[a.name] for a in ATTRIBUTES if values.get(a.name) is not None}

    @classmethod
    def from_parameters(cls, parameters: Tensors) -> Gaussians:
        """Return N Gaussians made of `parameters`, for instance of an optimiser, with gradients.

        Args:
            parameters: tensors [N, ...] by the names that `Gaussians.parameters` returns; entries
                of other names are ignored.

        Raises:
            ValueError: one that all Gaussians have is missing, or as for `Gaussians`.
        """
        required = ("means", "log_scales", "quats", "logit_opacities", "sh_dc")
        missing = [name for name in required if name not in parameters]
        require(
            not missing,
            "Gaussians.from_parameters()",
            f"`parameters` must have {', '.join(required)}",
            f"none of the name {', '.join(missing)}",
            "see Gaussians.parameters()",
        )
        # In the order of the table: kernels in Dr.Jit's cache have the order of their trace.
        given = {name: parameters[name] for name in BY_NAME if name in parameters}
        return cls(**_raw_attributes(given))

    def with_parameters(self, parameters: Tensors) -> Gaussians:
        """Return these Gaussians with some of their `parameters` replaced.

        Where `sh_dc` is given, `sh_rest` is taken from `parameters` too; without it the degree
        becomes 0.
        """
        if "sh_rest" in parameters and "sh_dc" not in parameters:
            parameters = {**parameters, "sh_dc": split_sh(self.sh_coeffs)[0]}
        return replace(self, **_raw_attributes(parameters))

    def items(self) -> Tensors:
        """Return the raw attributes that are present, by the names of the fields."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def numpy(self) -> Arrays:
        """Return copies of the raw attributes that are present, as NumPy arrays."""
        return {name: np.array(dr.detach(value)) for name, value in self.items().items()}

    def detached(self) -> Gaussians:
        """Return the same values, detached from the gradient graph."""
        return replace(self, **{name: dr.detach(value) for name, value in self.items().items()})

    def rows(self, name: str, index: UInt32) -> list[Float]:
        """Return an activated attribute of the Gaussians at `index` (see `tensor_rows`): read
        first, then activated.
        """
        if name == "sh_coeffs":
            return tensor_rows(self.sh_coeffs, index)
        attribute = BY_ACTIVATED_NAME[name]
        return [
            attribute.activation.function(column)
            for column in tensor_rows(getattr(self, attribute.name), index)
        ]

    def select(self, index: np.ndarray) -> Gaussians:
        """Return the Gaussians at `index` [M] (integers, or a mask [N]), without gradients."""
        rows = np.atleast_1d(np.arange(len(self))[index])
        if not len(rows):
            return Gaussians(**{name: value[rows] for name, value in self.numpy().items()})
        lanes = from_numpy(mi.UInt32, rows)
        values = {name: rows_of(value, lanes) for name, value in self.items().items()}
        dr.eval(values)
        return Gaussians(**values)

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        """Return the Gaussians of all `parts` in order.

        Raises:
            ValueError: there are no parts, or they have different attributes.
        """
        require(
            len({(part.sh_degree, *part.items()) for part in parts}) == 1,
            "Gaussians.concatenate()",
            "`parts` must hold at least one, all with the same attributes and SH degree",
            [(f"SH degree {part.sh_degree}", *part.items()) for part in parts],
            "drop or add `motion`, `offset` and `logit_confidence`",
        )
        count = sum(map(len, parts))
        if not count:
            return parts[0]
        columns = [part.detached().items() for part in parts if len(part)]
        values = {}
        for name, first in columns[0].items():
            numbers = concatenated([column[name].array for column in columns])
            values[name] = mi.TensorXf(numbers, (count, *first.shape[1:]))
        dr.eval(values)
        return Gaussians(**values)


def split_sh(sh_coeffs: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return the constant coefficient [N, 1, 3] and the others [N, K - 1, 3], or None where there
    are none.
    """
    K = int(sh_coeffs.shape[1])
    return (sh_coeffs, None) if K == 1 else (sh_coeffs[:, :1], sh_coeffs[:, 1:])


def _raw_attributes(parameters: Tensors) -> Tensors:
    """Return parameters with the spherical harmonics in one part, where they are given."""
    values = dict(parameters)
    if "sh_dc" in values:
        values["sh_coeffs"] = join_sh(values.pop("sh_dc"), values.pop("sh_rest", None))
    return values


def join_sh(sh_dc: Tensor, sh_rest: Tensor | None) -> Tensor:
    """Return the coefficients [N, K, 3] of the two results of `split_sh`."""
    if sh_rest is None:
        return sh_dc
    N = int(sh_dc.shape[0])
    K = int(sh_rest.shape[1]) + 1
    lane = dr.arange(mi.UInt32, N * K * 3)
    row = lane // (3 * K)
    column = lane % (3 * K)
    is_dc = column < 3
    (dc,) = read_columns(sh_dc.array, row * 3 + column, 1, is_dc)
    (rest,) = read_columns(sh_rest.array, row * (3 * K - 3) + column - 3, 1, ~is_dc)
    return mi.TensorXf(dc + rest, (N, K, 3))

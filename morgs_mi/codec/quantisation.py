"""Gaussians <-> integers: every number is a multiple of a step, which stays the same for the life
of its Gaussian.

    value = q * 2^(e / 4)        q int32, e int8: quarter octaves

The columns of `values` [N, C] form groups, one per stored row of the attribute table
(`core.attributes`), in its order:

    means            3       world units
    log_scales       3
    quats            3       quats without their largest component, divided by it: (u, v, w)
                             stands for (1, u, v, w) / length
    logit_opacities  1
    sh_dc            3
    sh_rest          3 K-3
    any other row            optional attributes, e.g. logit_confidence with 1 column; a bit mask
                             determines which exist

`exponents` [N, E] has one e per axis of log_scales and one for every other group. A decoder
computes everything element by element in float64. IEEE 754 determines the rounding of the
operations: no machine, library or number of threads can change a bit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod

import numpy as np

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.entropy import LIMIT
from morgs_mi.core.attributes import ATTRIBUTES, SIGMOID
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Arrays

_STORED = {row.name: row for row in ATTRIBUTES if row.error is not None}
_ERRORS = {row.name: row.error for row in ATTRIBUTES if row.error is not None}  # tolerated
# Every stream has these groups, and `_exponents` has a rule for each; all others are optional.
_ALWAYS = ("means", "log_scales", "quats", "logit_opacities", "sh_dc", "sh_rest")
_OPTIONAL = tuple(name for name in _STORED if name not in _ALWAYS)  # by bit of the mask
GROUPS = (*_ALWAYS, *_OPTIONAL)
"""Names of the groups of columns, in their order."""
KNOWN_OPTIONAL = (1 << len(_OPTIONAL)) - 1
"""Bit mask of all optional attributes that this release can decode."""

_QUARTERS = np.array([1.0, 1.189207115002721, 1.4142135623730951, 1.681792830507429])  # 2^(k/4)
# Steps by e mod 256.
_STEPS = np.ldexp(_QUARTERS[np.arange(256) & 3], np.arange(256).astype(np.int8) >> 2)
# Values beyond these bounds make no visible difference, and one outlier must not cost the others
# their steps.
_MAX_RATIO = 4096.0
_MAX_LOGIT = 16.0
_MAX_OPTIONAL = 6.0
_MIN_SIZE_PX = 0.5  # smaller splats are blurred to about this size when they are drawn
_MAX_BITS = 24  # of an integer of a new Gaussian
# Stays within the limit when it is rounded to the coarsest change (see `packets`).
_MAX_VALUE = LIMIT - 2**20


@dataclass(frozen=True, eq=False)
class Grid:
    """N Gaussians as integers."""

    values: np.ndarray  #: int32 [N, C].
    exponents: np.ndarray  #: int8 [N, E].
    #: uint8 [N], the component of each quaternion that is not stored.
    largest_components: np.ndarray
    degree: int  #: Of the spherical harmonics, 0 to 3.
    optional: int  #: Bit mask of the optional attributes, see `optional_mask`.

    def __len__(self) -> int:
        return len(self.values)

    @property
    def num_integers(self) -> int:
        """Number of integers of a Gaussian."""
        return num_integers(self.degree, self.optional)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Columns of each group; groups of no width are left out."""
        return columns_of(self.degree, self.optional)

    def steps(self, name: str) -> np.ndarray:
        """Return the steps of a group, float64 [N, 3] for `log_scales`, [N, 1] for every other."""
        names = (*_ALWAYS, *optional_names(self.optional))
        columns = _slices({name: 3 if name == "log_scales" else 1 for name in names})
        return step_sizes(self.exponents[:, columns[name]])

    def real(self, name: str) -> np.ndarray:
        """Return the numbers that the integers of a group stand for, float64 [N, its width]."""
        return self.values[:, self.columns[name]] * self.steps(name)

    def select(self, index: np.ndarray) -> Grid:
        """Return the Gaussians at `index`."""
        return replace(
            self,
            values=self.values[index],
            exponents=self.exponents[index],
            largest_components=self.largest_components[index],
        )

    def concatenate(self, other: Grid) -> Grid:
        """Return these Gaussians followed by `other`, which has the same columns."""
        return replace(
            self,
            values=np.concatenate([self.values, other.values]),
            exponents=np.concatenate([self.exponents, other.exponents]),
            largest_components=np.concatenate([self.largest_components, other.largest_components]),
        )

    def gaussians(self, motion: np.ndarray | None = None) -> Gaussians:
        """Return the Gaussians that the integers stand for.

        Args:
            motion: displacement since the frame before, float32 [N, 3]; None for zero.
        """
        optional = {
            name: self._single(name).reshape(len(self), *_STORED[name].shape)
            for name in optional_names(self.optional)
        }
        sh = [self._single(name) for name in ("sh_dc", "sh_rest") if name in self.columns]
        return Gaussians(
            means=self._single("means"),
            log_scales=self._single("log_scales"),
            quats=self._quats(),
            logit_opacities=self._single("logit_opacities")[:, 0],
            sh_coeffs=np.concatenate(sh, 1).reshape(len(self), (self.degree + 1) ** 2, 3),
            motion=np.zeros((len(self), 3), np.float32) if motion is None else motion,
            **optional,
        )

    def _single(self, name: str) -> np.ndarray:
        """Return the numbers of a group in float32 [N, its width]."""
        return self.real(name).astype(np.float32)

    def _quats(self) -> np.ndarray:
        """Return the rotations as unit quaternions wxyz, float32 [N, 4]."""
        ratios = self.real("quats")
        u, v, w = np.ascontiguousarray(ratios.T)
        length = np.sqrt(((1 + u * u) + v * v) + w * w)
        quats = np.empty((len(self), 4), np.float32)
        is_largest = _is_largest(self.largest_components)
        quats[is_largest] = 1 / length
        quats[~is_largest] = (ratios / length[:, None]).ravel()
        return quats


def _is_largest(largest_components: np.ndarray) -> np.ndarray:
    """Return the mask of the component of each quaternion that is not stored, bool [N, 4]."""
    return np.arange(4) == largest_components[:, None]


def optional_mask(names: Collection[str]) -> int:
    """Return the bit mask of the optional attributes among `names`: bit k stands for the k-th in
    the table.
    """
    return sum(1 << bit for bit, name in enumerate(_OPTIONAL) if name in names)


def optional_names(mask: int) -> tuple[str, ...]:
    """Return the names of the optional attributes of a bit mask, in the order of the table."""
    return tuple(name for bit, name in enumerate(_OPTIONAL) if mask >> bit & 1)


def columns_of(degree: int, optional: int) -> dict[str, slice]:
    """Return the columns of each group, in order; groups of no width are left out."""
    widths = {}
    for name in (*_ALWAYS, *optional_names(optional)):
        shape = (3,) if name == "quats" else _STORED[name].shape
        # -1 in a shape is the number of SH coefficients beyond the first.
        if width := prod((degree + 1) ** 2 - 1 if n < 0 else n for n in shape):
            widths[name] = width
    return _slices(widths)


def num_exponents(optional: int) -> int:
    """Return the number E of exponents of a Gaussian."""
    return len(_ALWAYS) + 2 + optional.bit_count()


def num_integers(degree: int, optional: int) -> int:
    """Return the number of integers of a Gaussian: largest component, E exponents, C values."""
    *_, last = columns_of(degree, optional).values()
    return 1 + num_exponents(optional) + last.stop


def _slices(widths: Mapping[str, int]) -> dict[str, slice]:
    slices = {}
    first = 0
    for name, width in widths.items():
        slices[name] = slice(first, first + width)
        first += width
    return slices


def step_sizes(exponents: np.ndarray) -> np.ndarray:
    """Return 2^(e / 4) as float64 for integers e of -128 to 127: one of four factors, times a power
    of two.
    """
    return _STEPS[exponents.astype(np.uint8)]


def bounded(values: np.ndarray, low: int, high: int) -> np.ndarray:
    """Return integers that lie in low..high.

    Raises:
        ValueError: they do not.
    """
    if np.any((values < low) | (values > high)):
        raise ValueError(f"its integers must lie between {low} and {high}")
    return values


def groups_of(gaussians: Gaussians) -> Arrays:
    """Return the raw attributes [N, ...] of Gaussians by group: the spherical harmonics in two
    parts.
    """
    fields = gaussians.numpy()
    sh = fields["sh_coeffs"]
    fields = {**fields, "sh_dc": sh[:, :1], "sh_rest": sh[:, 1:]}
    return {name: fields[name] for name in GROUPS if name in fields}


def check_finite(groups: Arrays) -> None:
    """Raise a ValueError if a raw attribute is not finite."""
    for name, value in groups.items():
        bad = np.argwhere(~np.isfinite(value))
        if len(bad):
            raise ValueError(
                f"the stream: `{name}` must be finite, got NaN or infinity in Gaussian "
                f"{bad[0][0]}; lower the learning rates."
            )


def new_grid(raw: Arrays, cameras: Sequence[Camera], config: CodecConfig) -> Grid:
    """Return new Gaussians, given by their raw attributes by group, rounded to steps that are
    chosen here.
    """
    raw = {name: np.asarray(value, np.float64) for name, value in raw.items()}
    grid = Grid(
        values=np.zeros((0, 0), np.int32),
        exponents=_exponents(raw, cameras, config),
        largest_components=np.abs(raw["quats"]).argmax(1).astype(np.uint8),
        degree=round((1 + raw["sh_rest"].shape[1]) ** 0.5) - 1,
        optional=optional_mask(raw),
    )
    values = np.rint(real_values(raw, grid)).astype(np.int32)
    return replace(grid, values=np.ascontiguousarray(values.T))


def real_values(raw: Arrays, grid: Grid) -> np.ndarray:
    """Return unrounded `Grid.values` of other raw attributes by group, float64 [C, N], with the
    steps of `grid`.
    """
    N = len(grid.largest_components)
    # The other components of the quaternions relative to the largest one. What was the largest at
    # birth is zero after a turn by 180 degrees; the ratio is then very large.
    quats = np.asarray(raw["quats"], np.float64)
    is_largest = _is_largest(grid.largest_components)
    largest = quats[is_largest][:, None]
    ratios = quats[~is_largest].reshape(-1, 3) / np.where(np.abs(largest) < 1e-12, 1e-12, largest)
    numbers = {
        **raw,
        "quats": np.clip(ratios, -_MAX_RATIO, _MAX_RATIO),
        "logit_opacities": np.clip(raw["logit_opacities"], -_MAX_LOGIT, _MAX_LOGIT),
    }
    for name in optional_names(grid.optional):
        if _STORED[name].activation is SIGMOID:  # which saturates
            numbers[name] = np.clip(raw[name], -_MAX_OPTIONAL, _MAX_OPTIONAL)
    real = np.concatenate(
        [
            numbers[name].reshape(N, at.stop - at.start).T / grid.steps(name).T
            for name, at in grid.columns.items()
        ]
    )
    return np.clip(real, -_MAX_VALUE, _MAX_VALUE, out=real)


def _exponents(raw: Arrays, cameras: Sequence[Camera], config: CodecConfig) -> np.ndarray:
    """Return quarter octaves int8 [N, E] of steps, which are twice the error that `config`
    tolerates.
    """
    error = _doubled_error("means", config)
    color = _doubled_error("sh_dc", config)
    pixel = _world_per_pixel(raw["means"], cameras)[:, None]
    one = np.ones_like(pixel)
    sizes = np.exp(np.minimum(raw["log_scales"], 80.0)) / pixel
    sizes = np.maximum(sizes, _MIN_SIZE_PX)
    # A ball tolerates any turn.
    elongation = np.sqrt(sizes.max(1, keepdims=True) ** 2 - sizes.min(1, keepdims=True) ** 2)
    elongation = np.maximum(elongation, _MIN_SIZE_PX)
    # Of each group: step of all Gaussians, factor and largest absolute value of each one, [N, 1],
    # or [N, 3] for the axes of `log_scales`.
    rules = [
        (error, pixel, np.abs(raw["means"]).max(1, keepdims=True)),
        (error, 1 / sizes, np.abs(raw["log_scales"])),
        (error / 2, 1 / elongation, one),  # quats: a turn by a changes tan(a / 2)
        (_generic_step("logit_opacities", config), one, one),
        (color / SH_C0, one, np.abs(raw["sh_dc"]).max((1, 2))[:, None]),
        (color, one, np.abs(raw["sh_rest"]).max((1, 2), initial=0)[:, None]),
        *((_generic_step(name, config), one, one) for name in optional_names(optional_mask(raw))),
    ]
    columns = []
    for step, factor, magnitude in rules:
        # The factor of a Gaussian in whole octaves, which take fewer bits than they save.
        e = np.floor(4 * np.log2(step)) + 4 * np.floor(np.log2(factor))
        # Close to a lens, and for huge splats, steps would be finer than float32, and the integers
        # without bound.
        finest = np.ceil(4 * (np.log2(np.maximum(magnitude, 1e-38)) - _MAX_BITS))
        columns.append(np.maximum(e, finest))
    return np.clip(np.concatenate(columns, axis=1), -128, 127).astype(np.int8)


def _doubled_error(name: str, config: CodecConfig) -> float:
    """Return twice the error that is tolerated in the activated value of an attribute."""
    return 2 * _ERRORS[name] / (config.quality * config.birth_precision)


def _generic_step(name: str, config: CodecConfig) -> float:
    """Return the step. Half of it changes the activated value by the tolerated error where it is
    most sensitive.

    Where the slope of the activation has no bound, the error applies to the optimised value.
    """
    return _doubled_error(name, config) / (_STORED[name].activation.largest_slope or 1.0)


def _world_per_pixel(means: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the size of a pixel [N] at each mean, world units, in the camera that magnifies it
    most.
    """
    pixel = np.full(len(means), np.inf)
    for camera in cameras:
        view = camera.world_to_camera
        depth = means @ view[2, :3] + view[2, 3]
        focal = max(camera.K[0, 0], camera.K[1, 1])
        pixel = np.minimum(pixel, np.where(depth > camera.near, depth, np.inf) / focal)
    sizes = pixel[np.isfinite(pixel)]
    # A Gaussian behind every camera is invisible but may come into view.
    return np.where(np.isfinite(pixel), pixel, np.median(sizes) if len(sizes) else 1e-3)

"""Gaussians <-> integers: every number is a multiple of a step that its Gaussian keeps for life.

    value = q * 2^(e / 4)        q int32, e int8: quarter octaves

The columns of `values` [N, C], C = 11 + 3 K (one less without confidence), stand in groups:

    position 3   means, world units
    size 3       log_scales
    rotation 3   quats without their largest component, divided by it: (u, v, w) stands for (1, u, v, w) / length
    opacity 1    logit_opacities
    color 3      SH of degree 0
    shine 3 K-3  SH of degree 1 and up
    confidence 1 logit_confidence

`exponents` [N, 8 or 9] hold one e per axis of the size and one for every other group. Everything a decoder computes
is element by element in float64, with operations that IEEE 754 rounds in one way only: no machine, library or
number of threads can change a bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from morgs_mi.codec.config import CodecConfig
from morgs_mi.codec.entropy import LIMIT
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians

__all__ = ["GROUPS", "Grid", "attributes", "bounded", "columns_of", "new_grid", "real_values", "step_sizes"]

GROUPS = ("position", "size", "rotation", "opacity", "color", "shine", "confidence")

_QUARTERS = np.array([1.0, 1.189207115002721, 1.4142135623730951, 1.681792830507429])  # 2^(k/4)
_STEPS = np.ldexp(_QUARTERS[np.arange(256) & 3], np.arange(256).astype(np.int8) >> 2)  # by e mod 256
_EXPONENTS = {name: slice(k, k + 1) for k, name in zip((0, 1, 4, 5, 6, 7, 8), GROUPS, strict=True)} | {
    "size": slice(1, 4)
}
_DC = 0.28209479177387814  # basis function of degree 0
# Beyond these nothing can be seen, and one wild number must not cost the others their steps.
_MOST_TURN, _MOST_LOGIT, _MOST_CONFIDENCE = 4096.0, 16.0, 6.0
_SMALLEST_PX = 0.5  # splats below are blurred to about this size when drawn
_MOST_BITS = 24  # of an integer of who is new
_FURTHEST = LIMIT - 2**20  # rounded to the coarsest change (see `gaussians`), it still lies within the limit


@dataclass(frozen=True, eq=False)
class Grid:
    """N Gaussians as integers.

    Attributes:
        values: int32 [N, C].
        exponents: int8 [N, 8 or 9].
        largest_components: uint8 [N], the component of each quaternion that is not written.
        degree: of the spherical harmonics, 0 to 3.
    """

    values: np.ndarray
    exponents: np.ndarray
    largest_components: np.ndarray
    degree: int

    def __len__(self) -> int:
        return len(self.values)

    @property
    def has_confidence(self) -> bool:
        """Whether there is a column of confidences."""
        return self.exponents.shape[1] == 9

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where each group stands; those of no width are left out."""
        return columns_of(self.degree, self.has_confidence)

    def steps(self, name: str) -> np.ndarray:
        """Return the steps of a group, float64 [N, 3] for the size, [N, 1] for every other."""
        return step_sizes(self.exponents[:, _EXPONENTS[name]])

    def real(self, name: str) -> np.ndarray:
        """Return what the integers of a group stand for, float64 [N, its width]."""
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
        """Return these Gaussians and then those of `other`, which have the same columns."""
        both = {
            n: np.concatenate([getattr(self, n), getattr(other, n)])
            for n in ("values", "exponents", "largest_components")
        }
        return replace(self, **both)

    def gaussians(self, motion: np.ndarray | None = None, offset: np.ndarray | None = None) -> Gaussians:
        """Return what the integers stand for, with a displacement and its learned part float32 [N, 3].

        Without a displacement nothing has moved; without an offset nothing is known of it.
        """
        u, v, w = np.ascontiguousarray(self.real("rotation").T)
        length = np.sqrt(((1 + u * u) + v * v) + w * w)
        quats = np.empty((len(self), 4), np.float32)
        rows = np.arange(len(self))
        quats[rows, self.largest_components] = 1 / length
        for k, part in enumerate((u, v, w)):
            quats[rows, k + (k >= self.largest_components)] = part / length
        sh = np.concatenate(
            [self.real(name) for name in ("color", "shine") if name in self.columns], 1, dtype=np.float32
        )
        return Gaussians(
            means=self.real("position").astype(np.float32),
            log_scales=self.real("size").astype(np.float32),
            quats=quats,
            logit_opacities=self.real("opacity")[:, 0].astype(np.float32),
            sh_coeffs=sh.astype(np.float32).reshape(len(self), (self.degree + 1) ** 2, 3),
            motion=np.zeros((len(self), 3), np.float32) if motion is None else motion,
            logit_confidence=self.real("confidence")[:, 0].astype(np.float32) if self.has_confidence else None,
            offset=offset,
        )


def columns_of(degree: int, has_confidence: bool) -> dict[str, slice]:
    """Return where each group stands among the columns, in order; those of no width are left out."""
    widths = (3, 3, 3, 1, 3, 3 * ((degree + 1) ** 2 - 1), int(has_confidence))
    ends = np.cumsum(widths)
    return {name: slice(end - width, end) for name, width, end in zip(GROUPS, widths, ends, strict=True) if width}


def step_sizes(exponents: np.ndarray) -> np.ndarray:
    """Return 2^(e / 4) as float64 for integers e of -128 to 127: a factor out of four, times a power of two."""
    return _STEPS[exponents.astype(np.uint8)]


def bounded(values: np.ndarray, limit: int, what: str) -> np.ndarray:
    """Return integers that lie in -limit..limit - 1.

    Raises:
        ValueError: they do not.
    """
    if np.any((values >= limit) | (values < -limit)):
        raise ValueError(f"an {what} must lie between -{limit} and {limit}")
    return values


def attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the raw attributes that a stream holds, by name.

    Raises:
        ValueError: one is not finite.
    """
    raw = {name: value for name, value in gaussians.numpy().items() if name not in ("motion", "offset")}
    for name, value in raw.items():
        if not np.isfinite(value).all():
            row = np.argwhere(~np.isfinite(value))[0][0]
            raise ValueError(
                f"the stream: `{name}` must be finite, that of Gaussian {row} is not; lower the learning rates."
            )
    return raw


def new_grid(raw: Mapping[str, np.ndarray], cameras: Sequence[Camera], config: CodecConfig) -> Grid:
    """Choose the steps of Gaussians that are new, given by their `attributes`, and round them to these."""
    raw = {name: np.asarray(value, np.float64) for name, value in raw.items()}
    largest_components = np.abs(raw["quats"]).argmax(1).astype(np.uint8)
    degree = round(raw["sh_coeffs"].shape[1] ** 0.5) - 1
    grid = Grid(np.zeros((0, 0), np.int32), _exponents(raw, cameras, config), largest_components, degree)
    values = np.rint(real_values(raw, grid)).astype(np.int32)
    return replace(grid, values=np.ascontiguousarray(values.T))


def real_values(raw: Mapping[str, np.ndarray], grid: Grid) -> np.ndarray:
    """Return what `Grid.values` of other `attributes` would be without rounding, float64 [C, N]; N as in `grid`."""
    largest_components, rows = grid.largest_components, np.arange(len(grid.largest_components))
    quats, sh = np.asarray(raw["quats"], np.float64), raw["sh_coeffs"]
    others = np.stack([quats[rows, k + (k >= largest_components)] for k in range(3)], axis=1)
    pivot = quats[rows, largest_components][:, None]
    # A turn by 180 degrees away from where the pivot was chosen divides by zero: then "very far" is what is meant.
    turn = others / np.where(np.abs(pivot) < 1e-12, 1e-12, pivot)
    parts = {
        "position": raw["means"],
        "size": raw["log_scales"],
        "rotation": np.clip(turn, -_MOST_TURN, _MOST_TURN),
        "opacity": np.clip(raw["logit_opacities"], -_MOST_LOGIT, _MOST_LOGIT)[:, None],
        "color": sh[:, 0],
        "shine": sh[:, 1:].reshape(len(sh), 3 * sh.shape[1] - 3),
    }
    if grid.has_confidence:
        parts["confidence"] = np.clip(raw["logit_confidence"], -_MOST_CONFIDENCE, _MOST_CONFIDENCE)[:, None]
    real = np.empty((max(at.stop for at in grid.columns.values()), len(largest_components)))
    for name, at in grid.columns.items():
        np.divide(parts[name].T, grid.steps(name).T, out=real[at])
    return np.clip(real, -_FURTHEST, _FURTHEST, out=real)


def _exponents(raw: Mapping[str, np.ndarray], cameras: Sequence[Camera], config: CodecConfig) -> np.ndarray:
    """Return quarter octaves int8 [N, 8 or 9]: steps whose half is the error that `config` tolerates."""
    precision = config.quality * config.birth_precision
    error, color = 2 * config.error_px / precision, 2 * config.error_color / precision
    pixel, N = _world_per_pixel(raw["means"], cameras), len(raw["means"])
    sizes = np.maximum(np.exp(np.minimum(raw["log_scales"], 80.0)) / pixel[:, None], _SMALLEST_PX)  # px
    needle = np.maximum(np.sqrt(sizes.max(1) ** 2 - sizes.min(1) ** 2), _SMALLEST_PX)  # a ball may turn as it likes
    one = np.ones(N)
    # What every Gaussian tolerates, times what this one does.
    steps = [
        (error, pixel),
        *((error, 1 / size) for size in sizes.T),
        (error / 2, 1 / needle),  # a turn by a changes tan(a / 2)
        (8 * config.error_opacity / precision, one),  # the sigmoid's slope is 1/4 at most
        (color / _DC, one),
        (color, one),
        (8 * config.error_confidence / precision, one),
    ]
    # The latter in whole octaves, which take fewer bits than they save.
    e = [np.floor(4 * np.log2(shared)) + 4 * np.floor(np.log2(own)) for shared, own in steps]
    # Before a lens, and where splats are huge, that would be finer than float32 is, and its integers without bound.
    sh = np.abs(raw["sh_coeffs"])
    colors = sh[:, 0].max(1), sh[:, 1:].max((1, 2), initial=0)
    largest = [np.abs(raw["means"]).max(1), *np.abs(raw["log_scales"]).T, one, one, *colors, one]
    finest = [np.ceil(4 * (np.log2(np.maximum(most, 1e-38)) - _MOST_BITS)) for most in largest]
    return np.clip(np.maximum(e, finest).T, -128, 127).astype(np.int8)[:, : 8 + ("logit_confidence" in raw)]


def _world_per_pixel(means: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the size of a pixel [N] at each centre, world units, in the camera that sees it largest."""
    pixel = np.full(len(means), np.inf)
    for camera in cameras:
        view = np.asarray(camera.viewmat, np.float64)
        depth = means @ view[2, :3] + view[2, 3]
        focal = max(camera.K[0, 0], camera.K[1, 1])
        pixel = np.minimum(pixel, np.where(depth > camera.near, depth, np.inf) / focal)
    seen = pixel[np.isfinite(pixel)]
    # Behind every camera there is nothing to see; it may come into view.
    return np.where(np.isfinite(pixel), pixel, np.median(seen) if len(seen) else 1e-3)

"""Changes between two frames <-> columns: flags first, then the integers of the flagged groups.

Each Gaussian has one flag for each of the three groups of its geometry and one for each other
group, or is marked dead. The Gaussians that moved last and the static ones, as far as the
confidence distinguishes them, are coded separately, because their flags and residuals differ most.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from morgs_mi.codec.entropy import LIMIT, ColumnReader
from morgs_mi.codec.quantisation import GROUPS, Grid, bounded, step_sizes

# Flags of the geometry of a Gaussian that dies; the first three groups are the bits below, all
# others those above.
_DEAD = 8
# Changes below a step are jitter of the fit, but in the base colour every bit is visible. Slightly
# less than a step, because a decoded state is rounded to float32 and must give the packet that it
# was decoded from.
_THRESHOLD = 0.99
_THRESHOLD_DC = 0.5


@dataclass(frozen=True, eq=False)
class Coder:
    """Coder of the changes from a state to the next Gaussians, with any quantizer step."""

    grid: Grid  #: The N Gaussians of the state.
    survivors: np.ndarray  #: Their indices in the state [S], ascending; the others die.
    rows: np.ndarray  #: Indices of the M survivors that differ.
    change: np.ndarray  #: Their differences by integer, in multiples of the grid's steps [C, M].

    def rounded(self, quantizer_step: int) -> np.ndarray:
        """Return the changes in whole steps, int32 [C, N]."""
        r = np.zeros((len(self.change), len(self.grid)), np.int32)
        steps = self.change / _step(quantizer_step)
        for name, at in self.grid.columns.items():
            threshold = _THRESHOLD_DC if name == "sh_dc" else _THRESHOLD
            steps[at, np.max(np.abs(steps[at]), axis=0) < threshold] = 0
        r[:, self.rows] = np.clip(np.rint(steps, out=steps), 1 - LIMIT, LIMIT - 1, out=steps)
        return r

    def columns(self, r: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the columns of changes `r` [C, N] and of the deaths; `take_change` reads them."""
        flags = np.zeros(len(self.grid), np.int32)
        for name, at in self.grid.columns.items():
            flags |= np.any(r[at], axis=0).astype(np.int32) << GROUPS.index(name)
        dead = np.ones(len(self.grid), bool)
        dead[self.survivors] = False
        geometry = np.where(dead, _DEAD, flags % _DEAD)
        for rows in _classes(self.grid):
            yield geometry[rows]
            for some in _shape_classes(geometry[rows]):
                yield flags[rows[some]] // _DEAD
            for name, at in self.grid.columns.items():
                yield from r[at].take(rows[flags[rows] >> GROUPS.index(name) & 1 == 1], axis=1)


def take_change(
    reader: ColumnReader, grid: Grid, quantizer_step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the integers int32 [N, C] after changes with a quantizer step, and the mask of
    deaths, bool [N].

    Raises:
        ValueError: the columns do not describe changes, or a value leaves its range.
    """
    values = grid.values.copy()
    dead = np.zeros(len(grid), bool)
    step = _step(quantizer_step)
    bits = sum(1 << GROUPS.index(name) for name in grid.columns) // _DEAD
    for rows in _classes(grid):
        geometry = reader.take(len(rows))
        appearance = np.zeros(len(rows), np.int64)
        for some in _shape_classes(geometry):
            appearance[some] = reader.take(int(some.sum()))
        if np.any((geometry < 0) | (geometry > _DEAD) | (appearance & ~bits != 0)):
            raise ValueError("its flags name groups that do not exist")
        dead[rows] = geometry == _DEAD
        flags = geometry % _DEAD + appearance * _DEAD  # bit k: the k-th of all groups changes
        for name, at in grid.columns.items():
            changed = rows[flags >> GROUPS.index(name) & 1 == 1]
            for column in values.T[at]:
                change = np.rint(reader.take(len(changed)) * step).astype(np.int64)
                column[changed] = bounded(column[changed] + change, -LIMIT, LIMIT - 1)
    return values, dead


def _shape_classes(geometry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks of the Gaussians that keep their geometry, and of those that change it."""
    return geometry == 0, (geometry > 0) & (geometry < _DEAD)


def _classes(grid: Grid) -> list[np.ndarray]:
    """Return the indices of the static and of the moving Gaussians; without confidence, all count
    as static.
    """
    confidence = grid.columns.get("logit_confidence")
    moving = (
        np.zeros(len(grid), bool) if confidence is None else grid.values[:, confidence.start] > 0
    )
    return [np.flatnonzero(~moving), np.flatnonzero(moving)]


def _step(quantizer_step: int) -> np.ndarray:
    """Return the step of the changes in multiples of the grid's steps."""
    return step_sizes(np.array(quantizer_step))

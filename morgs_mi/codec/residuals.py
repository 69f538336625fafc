"""Changes between two frames <-> columns: flags first, then the integers of the flagged groups.

Each Gaussian has one flag for each of the three groups of its geometry and one for each other group, or is marked dead.
The Gaussians that moved last and the static ones, as far as the confidence distinguishes them, are coded separately,
because their flags and residuals differ most.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morgs_mi.codec.entropy import LIMIT, ColumnReader
from morgs_mi.codec.quantisation import GROUPS, Grid, bounded

__all__ = ["columns_of_change", "take_change"]

_GEOMETRY, _APPEARANCE, _DEAD = GROUPS[:3], GROUPS[3:], 8


def columns_of_change(r: np.ndarray, dead: np.ndarray, grid: Grid) -> Iterator[np.ndarray]:
    """Yield the columns of changes by integers [C, N] and of deaths; `take_change` reads them."""
    changed = {name: np.any(r[at], axis=0) for name, at in grid.columns.items()}
    geometry = np.where(dead, _DEAD, _flags(changed, _GEOMETRY, len(grid)))
    appearance = _flags(changed, _APPEARANCE, len(grid))
    for rows in _classes(grid):
        shape, shading = geometry[rows], appearance[rows]
        yield shape
        yield shading[shape == 0]
        yield shading[(shape > 0) & (shape < _DEAD)]
        for name, at in grid.columns.items():
            yield from r[at].take(rows[changed[name][rows]], axis=1)


def take_change(reader: ColumnReader, grid: Grid, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the integers int32 [N, C] after changes in multiples of `step`, and the mask of deaths, bool [N].

    Raises:
        ValueError: the columns are not those of changes, or a value leaves its range.
    """
    values, dead = grid.values.copy(), np.zeros(len(grid), bool)
    for rows in _classes(grid):
        geometry, appearance = reader.take(len(rows)), np.zeros(len(rows), np.int64)
        for some in (geometry == 0, (geometry > 0) & (geometry < _DEAD)):
            appearance[some] = reader.take(int(some.sum()))
        known = sum(1 << bit for bit, name in enumerate(_APPEARANCE) if name in grid.columns)
        if np.any((geometry < 0) | (geometry > _DEAD) | (appearance & ~known != 0)):
            raise ValueError("its flags name groups that do not exist")
        dead[rows] = geometry == _DEAD
        flags = {name: (geometry >> bit & 1) & (geometry < _DEAD) for bit, name in enumerate(_GEOMETRY)}
        flags |= {name: appearance >> bit & 1 for bit, name in enumerate(_APPEARANCE)}
        for name, at in grid.columns.items():
            changed = rows[flags[name] == 1]
            for column in range(at.start, at.stop):
                new = values[changed, column] + np.rint(reader.take(len(changed)) * step).astype(np.int64)
                values[changed, column] = bounded(new, LIMIT, "value")
    return values, dead


def _flags(changed: dict[str, np.ndarray], names: tuple[str, ...], N: int) -> np.ndarray:
    """Return the sum of 2^k [N] over those of the groups `names` that change, k being their place."""
    flags = np.zeros(N, np.int32)
    for bit, name in enumerate(names):
        if name in changed:
            flags |= changed[name].astype(np.int32) << bit
    return flags


def _classes(grid: Grid) -> list[np.ndarray]:
    """Return the indices of the static and of the moving Gaussians; without confidence, all count as static."""
    confidence = grid.columns.get("logit_confidence")
    moving = np.zeros(len(grid), bool) if confidence is None else grid.values[:, confidence.start] > 0
    return [np.flatnonzero(~moving), np.flatnonzero(moving)]

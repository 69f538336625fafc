"""What changes between two frames <-> columns: flags first, then the integers of what they name.

Each Gaussian has a flag for each of the three groups of its geometry and the four of its look, or died. Those that
moved last and those that stood are coded apart, as far as the confidence knows: their flags and residuals differ most.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morgs_mi.codec.entropy import LIMIT, ColumnReader
from morgs_mi.codec.quantisation import GROUPS, Grid, bounded

__all__ = ["columns_of_change", "take_change"]

_GEOMETRY, _LOOK, _DEAD = GROUPS[:3], GROUPS[3:], 8


def columns_of_change(r: np.ndarray, dead: np.ndarray, grid: Grid) -> Iterator[np.ndarray]:
    """Yield the columns that say by how much integers [C, N] change, and who died; `take_change` reads them."""
    changed = {name: r[at].any(0) for name, at in grid.columns.items()}
    geometry = sum(changed[name].astype(np.uint8) << bit for bit, name in enumerate(_GEOMETRY))
    look = sum(changed[name].astype(np.uint8) << bit for bit, name in enumerate(_LOOK) if name in changed)
    geometry = np.where(dead, _DEAD, geometry)
    for rows in _classes(grid):
        shape, shade = geometry[rows], look[rows]
        yield shape
        yield shade[shape == 0]
        yield shade[(shape > 0) & (shape < _DEAD)]
        for name, at in grid.columns.items():
            yield from r[at].take(rows[changed[name][rows]], axis=1)


def take_change(reader: ColumnReader, grid: Grid, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the integers int32 [N, C] after changes that count `step` each, and who died, bool [N].

    Raises:
        ValueError: the columns are none of changes, or lead too far.
    """
    values, dead = grid.values.copy(), np.zeros(len(grid), bool)
    for rows in _classes(grid):
        geometry, look = reader.take(len(rows)), np.zeros(len(rows), np.int64)
        for some in (geometry == 0, (geometry > 0) & (geometry < _DEAD)):
            look[some] = reader.take(int(some.sum()))
        known = sum(1 << bit for bit, name in enumerate(_LOOK) if name in grid.columns)
        if np.any((geometry < 0) | (geometry > _DEAD) | (look & ~known != 0)):
            raise ValueError("its flags name groups that do not exist")
        dead[rows] = geometry == _DEAD
        flags = {name: (geometry >> bit & 1) & (geometry < _DEAD) for bit, name in enumerate(_GEOMETRY)}
        flags |= {name: look >> bit & 1 for bit, name in enumerate(_LOOK)}
        for name, at in grid.columns.items():
            who = rows[flags[name] == 1]
            for column in range(at.start, at.stop):
                moved = values[who, column] + np.rint(reader.take(len(who)) * step).astype(np.int64)
                values[who, column] = bounded(moved, LIMIT, "value")
    return values, dead


def _classes(grid: Grid) -> list[np.ndarray]:
    """Return the indices of those that stand and of those that move, as far as their confidence knows."""
    moves = grid.values[:, -1] > 0 if grid.has_confidence else np.zeros(len(grid), bool)
    return [np.flatnonzero(~moves), np.flatnonzero(moves)]

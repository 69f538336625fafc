"""Numbers of the images in folders: which number of a name is the frame's, and which cameras count
together.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

Key = TypeVar("Key")


def counting_together(numbers: Mapping[Key, Sequence[int]]) -> list[list[Key]]:
    """Return groups of cameras whose numbers overlap; numbers of different groups do not overlap.

    Args:
        numbers: numbers of the images of each camera, ascending and not empty.
    """
    groups: list[list[Key]] = []
    last = 0
    for key in sorted(numbers, key=lambda key: numbers[key][0]):
        if not groups or numbers[key][0] > last:
            groups.append([])
            last = numbers[key][-1]
        groups[-1].append(key)
        last = max(last, numbers[key][-1])
    return groups


def frame_numbers(folder: Path, names: Sequence[str]) -> list[int]:
    """Return the number in the name of each frame of one clip: the one that changes from name to
    name, or the last one, as in ``cam1_0000``, ``0000_cam1`` and ``0000``.

    Of several that change, it is the one with the most values, then with the fewest gaps, then the
    last one. A single name without a number has the number 0.

    Args:
        folder: the folder of the frames, for messages.
        names: names without suffixes.

    Raises:
        ValueError: a name has no number, or two have the same.
    """
    numbers = [list(map(int, reversed(re.findall(r"[0-9]+", name)))) for name in names]
    columns = list(zip(*numbers, strict=False)) if len(names) > 1 or any(numbers) else [(0,)]
    if not columns:
        name = names[numbers.index([])]
        raise ValueError(f"{folder}: expected a number in each name, got {name}; rename it.")
    best = min(
        columns,
        key=lambda column: (
            -len({*column}),
            (max(column) - min(column)) // (math.gcd(*(n - column[0] for n in column)) or 1),
        ),
    )
    last = dict(zip(best, names, strict=True))
    for number, name in zip(best, names, strict=True):
        if last[number] != name:
            raise ValueError(
                f"{folder}: expected one file of number {number}, got {name} and "
                f"{last[number]}; remove one."
            )
    return list(best)


def check_numbering(folder: Path, numbers: Sequence[int], names: Sequence[str]) -> None:
    """Raise an error unless the numbers of a folder's frames ascend in equal steps.

    Raises:
        ValueError: they do not; the sentence has the `names` before and behind the gap.
    """
    steps = np.diff(numbers)
    least = min(steps, default=1)
    if least < 1 or (steps != least).any():
        gap = int(np.argmax(steps != least) if least > 0 else np.argmin(steps))
        raise ValueError(
            f"{folder}: the frames must be numbered without gaps, got {names[gap]} followed by "
            f"{names[gap + 1]}; extract them again, or go on without the missing ones (--gaps)."
        )

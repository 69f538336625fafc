"""Numbers of the images in folders: which number of a name is the frame's, and whether the numbers
count.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np


def frame_numbers(folder: Path, names: Sequence[str]) -> list[int]:
    """Return the number in the name of each frame of one clip: the one that changes from name to
    name, or the last one, as in ``cam1_0000``, ``0000_cam1`` and ``0000``.

    Of several that change, it is the one with the most values, then the last one. It must order the
    frames as their names do: that of a time code does not, because it begins again with every
    second. A single name without a number has the number 0.

    Args:
        folder: the folder of the frames, for messages.
        names: names without suffixes.

    Raises:
        ValueError: a name has no number, two have the same, or the names have another order.
    """
    numbers = [list(map(int, reversed(re.findall(r"[0-9]+", name)))) for name in names]
    columns = list(zip(*numbers, strict=False)) if len(names) > 1 or any(numbers) else [(0,)]
    if not columns:
        name = names[numbers.index([])]
        raise ValueError(f"{folder}: expected a number in each name, got {name}; rename it.")
    best = max(columns, key=lambda column: len({*column}))
    in_order = sorted(zip(map(natural_key, names), best, names, strict=True))
    for (_, number, name), (_, next_number, next_name) in pairwise(in_order):
        if number >= next_number:
            raise ValueError(
                f"{folder}: expected one number in each name that counts the frames, got {name} "
                f"followed by {next_name}; rename the images to 0000, 0001, ... if their names are "
                "times, or move away those that are no frames of this clip."
            )
    return list(best)


def natural_key(name: str) -> list[str | int]:
    """Return a sorting key that places cam_2 before cam_10."""
    # split() with a group alternates text and digits, so keys compare text with text and int with
    # int.
    return [int(piece) if i % 2 else piece for i, piece in enumerate(re.split(r"([0-9]+)", name))]


def check_numbering(folder: Path, numbers: Sequence[int], names: Sequence[str]) -> int:
    """Return the step of the numbers of a folder's frames, if it is always the same.

    Args:
        folder: the folder, for messages.
        numbers: in ascending order.
        names: of the frames.

    Raises:
        ValueError: they are not; the sentence has the `names` before and behind the gap.
    """
    step = check_counting(folder, numbers, names)
    if len(gaps := np.flatnonzero(np.diff(numbers) > step)):
        raise ValueError(
            f"{folder}: the frames must be numbered without gaps, got {names[gaps[0]]} followed by "
            f"{names[gaps[0] + 1]}; extract them again, or go on without the missing ones (--gaps)."
        )
    return step


def check_counting(folder: Path, numbers: Sequence[int], names: Sequence[str]) -> int:
    """Return the smallest step of the ascending numbers of a folder's frames, if they count in
    multiples of it, as times in milliseconds do not; 1 for a single number.

    Raises:
        ValueError: they do not.
    """
    steps = np.diff(numbers)
    least = int(min(steps, default=1))
    if len(uneven := np.flatnonzero(steps % least)):
        raise ValueError(
            f"{folder}: expected numbers that count the frames in equal steps, got "
            f"{names[uneven[0]]} followed by {names[uneven[0] + 1]}, and steps of {least} between "
            "others; rename the images to 0000, 0001, ... if their names are times."
        )
    return least

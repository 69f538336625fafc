"""Numbers of the images in folders: which number of a name is the frame's, and whether the numbers
count.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np


def frames_by_number(folder: Path, files: Mapping[str, Path]) -> dict[int, Path]:
    """Return the files of the frames of one clip by the numbers in their names, ascending: those
    that change from name to name, or the last ones, as in ``cam1_0000``, ``0000_cam1`` and
    ``0000``.

    Of several that change, it is the one with the most values, then the last one. It must order the
    frames as their names do: that of a time code does not, because it begins again with every
    second. A single name without a number has the number 0.

    Args:
        folder: the folder of the frames, for messages.
        files: by their names without suffixes, at least one.

    Raises:
        ValueError: a name has no number, two have the same, or the names have another order.
    """
    names = sorted(files, key=natural_key)
    numbers = [list(map(int, reversed(re.findall(r"[0-9]+", name)))) for name in names]
    columns = list(zip(*numbers, strict=False)) if len(names) > 1 or any(numbers) else [(0,)]
    if not columns:
        name = names[numbers.index([])]
        raise ValueError(f"{folder}: expected a number in each name, got {name}; rename it.")
    best = max(columns, key=lambda column: len({*column}))
    frames = list(zip(best, names, strict=True))
    for (number, name), (next_number, next_name) in pairwise(frames):
        if number >= next_number:
            raise ValueError(
                f"{folder}: expected one number in each name that counts the frames, got {name} "
                f"followed by {next_name}; rename the images to 0000, 0001, ... if their names are "
                "times, or move away those that are no frames of this clip."
            )
    return {number: files[name] for number, name in frames}


def natural_key(name: str) -> list[str | int]:
    """Return a sorting key that places cam_2 before cam_10."""
    # split() with a group alternates text and digits, so keys compare text with text and int with
    # int.
    return [int(piece) if i % 2 else piece for i, piece in enumerate(re.split(r"([0-9]+)", name))]


def check_numbering(folder: Path, frames: Mapping[int, Path]) -> int:
    """Return the step of the numbers of a folder's frames, if it is always the same.

    Args:
        folder: the folder, for messages.
        frames: the files by their numbers, ascending.

    Raises:
        ValueError: it is not; the sentence has the names before and behind the gap.
    """
    step = check_counting(folder, frames)
    if len(gaps := np.flatnonzero(np.diff([*frames]) > step)):
        raise ValueError(
            f"{folder}: the frames must be numbered without gaps, got "
            f"{_neighbours(frames, gaps[0])}; extract them again, or go on without the missing "
            "ones (--gaps)."
        )
    return step


def check_counting(folder: Path, frames: Mapping[int, Path]) -> int:
    """Return the smallest step of the ascending numbers of a folder's frames, if they count in
    multiples of it, as times in milliseconds do not; 1 for a single number.

    Raises:
        ValueError: they do not.
    """
    steps = np.diff([*frames])
    least = int(min(steps, default=1))
    if len(uneven := np.flatnonzero(steps % least)):
        raise ValueError(
            f"{folder}: expected numbers that count the frames in equal steps, got "
            f"{_neighbours(frames, uneven[0])}, and steps of {least} between others; rename the "
            "images to 0000, 0001, ... if their names are times."
        )
    return least


def _neighbours(frames: Mapping[int, Path], index: int) -> str:
    """Return the names of a frame and the next one in words."""
    files = list(frames.values())
    return f"{files[index].name} followed by {files[index + 1].name}"

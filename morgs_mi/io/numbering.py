"""Numbers of the images in folders: which cameras count together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

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

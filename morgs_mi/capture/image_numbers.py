"""Alignment of folders of images by the numbers of their images.

The numbers are times: images with the same number are simultaneous. Cameras whose numbers do not
overlap, such as 1000 to 1010 and 2340 to 2350, count separately. The first images of such cameras
are simultaneous.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import lcm
from pathlib import Path

import numpy as np

from morgs_mi.io.numbering import counting_together
from morgs_mi.io.video import FolderReader, FrameReader


@dataclass(frozen=True)
class ImageNumbers:
    """Alignment of clips by the numbers of their images: image o + r t shows timestamp t."""

    offsets: np.ndarray  #: o of each clip [C].
    rates: np.ndarray  #: r of each clip [C].
    #: Time between two timestamps, in frames of the clip with the most frames per time.
    interval: float = 1.0
    notes: tuple[str, ...] = ()  #: A sentence for each assumption.


def align_numbers(
    path: Path,
    names: Sequence[str],
    readers: Sequence[FrameReader],
    trim: bool,
    offset: Mapping[str, float],
) -> ImageNumbers:
    """Return the alignment of the clips of the capture `path` by the numbers of their images.

    Args:
        path: the capture folder, for messages.
        names: names of the cameras.
        readers: one clip per camera.
        trim: whether to use only the numbers that all cameras have which count together.
        offset: as in `ReadConfig`; without `trim`, the images are aligned by their positions and
            `offset`.

    Raises:
        ValueError: numbers of cameras that count together differ and no option resolves it, or none
            are common.
    """
    numbers = {
        c: r.numbers
        for c, r in enumerate(readers)
        if isinstance(r, FolderReader) and r.numbers is not None
    }
    groups = counting_together(numbers)
    notes: tuple[str, ...] = ()
    if len(groups) > 1 and any(len(clip_numbers) > 1 for clip_numbers in numbers.values()):
        table = "; ".join(_table(names, numbers, group[:1]) for group in groups)
        notes = (
            f"The numbers of the images do not overlap: {table}. Cameras with such numbers begin "
            "at the same time.",
        )
    by_position = ImageNumbers(np.zeros(len(readers)), np.ones(len(readers)), notes=notes)
    different = [
        group for group in groups if len({(numbers[c][0], numbers[c].step) for c in group}) > 1
    ]
    if not different:
        return by_position
    table = "; ".join(_table(names, numbers, group) for group in different)
    if offset and not trim:
        note = f"Images are aligned by their positions and --offset, not by their numbers: {table}."
        return replace(by_position, notes=(*notes, note))
    group = {c: numbers[c] for c in different[0]}
    common = sorted(set.intersection(*map(set, group.values()))) if len(different) == 1 else []
    if not trim or not common:
        remedy = f"the {len(common)} common ones with --trim, " if common else ""
        raise ValueError(
            f"{path}: images with the same number must be simultaneous and all cameras must have "
            f"the same numbers, got {table}; use {remedy}all numbers with --gaps, which leaves "
            "out the cameras that lack an image, or the positions of the images in place of "
            f"their numbers with --offset {names[different[0][0]]} 0."
        )
    note = (
        f"Images with the same number are simultaneous: {table}. Used are {_range(common)}, which "
        "all cameras have."
    )
    steps = [clip.step for clip in group.values()]
    # Other clips start with the first of these numbers.
    first = min(clip[0] for clip in group.values())
    clips = [group.get(c, range(first, first + 1, min(steps))) for c in range(len(readers))]
    offsets = np.array([(common[0] - clip[0]) / clip.step for clip in clips])
    rates = np.array([lcm(*steps) / clip.step for clip in clips])
    return ImageNumbers(offsets, rates, lcm(*steps) / min(steps), (*notes, note))


def _table(names: Sequence[str], numbers: Mapping[int, range], group: Sequence[int]) -> str:
    """Return the numbers of the cameras in a group."""
    return ", ".join(f"{names[c]} {_range(numbers[c])}" for c in group)


def _range(numbers: Sequence[int]) -> str:
    if len(numbers) == 1:
        return str(numbers[0])
    text = f"{numbers[0]} to {numbers[-1]}"
    step = numbers[1] - numbers[0]
    return text if step == 1 else f"{text} by {step}"

"""Random streams of a fit: one for each purpose, none of which repeats another."""

from __future__ import annotations

from enum import IntEnum, auto

import numpy as np


class Stream(IntEnum):
    """Purposes of random numbers."""

    POINTS = auto()
    """Points of stereo that are kept."""
    REFINED_POINTS = auto()
    """Initial Gaussians of the refinement of cameras."""
    REFINEMENT = auto()
    """Its fits."""
    BALANCED_POINTS = auto()
    """Initial Gaussians of the balance of exposures."""
    BALANCE = auto()
    """Its fits."""
    WITHHELD_BLOCKS = auto()
    """Blocks of pixels that are withheld from a fit."""
    TIMING = auto()
    """Fits of the estimate of time offsets."""
    # 8 and 9 are left out: a number never changes, or all fits would.
    FIRST_FRAME = 10
    """First frame."""
    LATER_FRAMES = auto()
    """Later frames, by their index."""


def rng_of(seed: int, stream: Stream, index: int = 0) -> np.random.Generator:
    """Return the generator of a random stream.

    Args:
        seed: of all streams.
        stream: purpose of the numbers.
        index: of the frame or the fit, where a stream has several.
    """
    # NumPy fills short keys with zeros: keys of unequal length may collide.
    return np.random.default_rng([seed, stream, index])

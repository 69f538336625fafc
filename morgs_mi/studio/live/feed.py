"""Live images: what a fit gets whenever it is ready for its next frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of one camera."""

    image: np.ndarray  #: uint8 [H, W, 3], RGB.
    time: float  #: At which it arrived, s of `time.monotonic`.
    number: int  #: Its number among the camera's images, without gaps.


@dataclass(frozen=True, eq=False)
class FrameSet:
    """Images of the cameras at about one time."""

    #: Per camera uint8 [H, W, 3], RGB, None where it has none.
    images: tuple[np.ndarray | None, ...]
    #: Per camera the number of its image, or of its newest one before where it has none.
    numbers: tuple[int, ...]
    time: float  #: At which the last of the images arrived, s of `time.monotonic`.
    skew: float  #: Largest difference in time between two of the images, s.
    #: Number of images that each camera delivered after the frame set before and that are in none.
    dropped: int


def close_images(images: object) -> None:
    """End an iterator of images, if it is one that can be ended."""
    if (close := getattr(images, "close", None)) is not None:
        close()

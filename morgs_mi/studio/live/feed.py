"""The interface of live images: what a fit gets whenever it is ready for its next frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of one camera."""

    image: np.ndarray  #: uint8 [H, W, 3], RGB.
    time: float  #: At which it arrived, s of `time.monotonic`.
    number: int  #: Its number among the camera's images, without gaps.


@dataclass(frozen=True, eq=False)
class Bundle:
    """Images of the cameras at about one time."""

    #: Per camera uint8 [H, W, 3], RGB, None where it has none.
    images: tuple[np.ndarray | None, ...]
    #: Per camera the number of its image, or of its newest one before where it has none.
    numbers: tuple[int, ...]
    time: float  #: At which the last of the images arrived, s of `time.monotonic`.
    skew: float  #: Largest difference in time between two of the images, s.
    #: Number of images that each camera delivered after the bundle before and that are in none.
    dropped: int


class Feed(Protocol):
    """Live images of several cameras."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, known with the first bundle."""
        ...

    def newest(self, after: Bundle | None = None) -> Bundle | None:
        """Wait for the newest bundle and return it; None if no camera delivers images any more.

        The first bundle has an image of every camera.

        Args:
            after: the bundle before; all images of the new one are newer.

        Raises:
            OSError, ValueError: a camera cannot be opened, or has no first image; the folder of the
                images was removed.
        """
        ...

    def problem(self, camera: int) -> str:
        """Return why a camera has no image in the last bundle."""
        ...

    def ended(self) -> str:
        """Return why no camera delivers images any more."""
        ...

    def close(self) -> None:
        """End the reading."""
        ...


def bundled(
    shots: Sequence[Shot | None], numbers: Sequence[int], skew: float, dropped: int = 0
) -> Bundle:
    """Return the bundle of at least one shot.

    Args:
        shots: per camera its image, None where it has none.
        numbers: per camera the number of its newest image.
        skew: largest difference in time between two of the images, s.
        dropped: number of images of each camera after the bundle before.
    """
    return Bundle(
        tuple(shot and shot.image for shot in shots),
        tuple(shot.number if shot else number for shot, number in zip(shots, numbers, strict=True)),
        max(shot.time for shot in shots if shot is not None),
        skew,
        dropped,
    )


def close_images(images: object) -> None:
    """End an iterator of images, if it is one that can be ended."""
    if (close := getattr(images, "close", None)) is not None:
        close()

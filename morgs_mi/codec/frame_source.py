"""Sources of frames: the Gaussians of a stream or of a file, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from morgs_mi.codec.container import Packet
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.platform.bounded import JsonObject


@dataclass(frozen=True, eq=False)
class FrameState:
    """Gaussians of one frame."""

    frame: int  #: Index of the video frame.
    #: uint32 [N], ascending: the number of each Gaussian from its birth to its death.
    ids: np.ndarray
    #: The N Gaussians; `motion` is the displacement since the frame before, zero where there is
    #: none, `offset` its learned part, None if the packet does not contain it.
    gaussians: Gaussians
    #: Number of ids in earlier sets since decoding began; a keyframe of a new frame begins a set.
    first_id: int = field(default=0, kw_only=True)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def lasting_ids(self) -> np.ndarray:
        """Ids that differ between sets as well, int64 [N]; in each set, `ids` start from 0."""
        return self.ids.astype(np.int64) + self.first_id


class FrameSource(Protocol):
    """Frames of Gaussians with their cameras: a `StreamReader`, or a `SplatFile` with a single
    frame.

    Iterating yields packets, into which a file of Gaussians is coded.

    Attributes:
        path: the file.
        cameras: the rig.
        fps: frames per second.
        metadata: metadata of the stream.
    """

    path: Path
    cameras: tuple[Camera, ...]
    fps: float
    metadata: JsonObject

    def __iter__(self) -> Iterator[Packet]: ...

    def frame_numbers(self) -> list[int]:
        """Return the indices of the frames, without decoding them."""
        ...

    def states(self, near: int | None = None) -> Iterator[FrameState]:
        """Yield the state of each frame, from the first one, or from one at or before the frame
        `near`.

        Raises:
            ValueError: a packet is broken, or `near` is given for a pipe.
        """
        ...

    def seek(self, frame: int) -> FrameState:
        """Return the state of a frame; decoding starts near it.

        Raises:
            ValueError: there is no such frame, it is a pipe, or a packet is broken.
        """
        state = next((state for state in self.states(frame) if state.frame >= frame), None)
        if state is None or state.frame != frame:
            raise ValueError(f"{self.path}: expected a frame of the stream, got {frame}.")
        return state


def play(source: FrameSource) -> Iterator[tuple[int, Gaussians]]:
    """Yield (frame, Gaussians) of each frame; errors as `FrameSource.states`."""
    return ((state.frame, state.gaussians) for state in source.states())

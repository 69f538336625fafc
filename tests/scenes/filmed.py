"""A recording of two textured planes that move in front of others, by cameras with clocks that may
be apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.core.camera import Camera
from tests.scenes import textured

COUNT = 4
FPS = 30.0
Clips = list[list[np.ndarray | None]]


class Filmed(Capture):
    """A capture of images in memory."""

    clips: Clips

    def partial_frames(self, start: int = 0, stop: int | None = None) -> Iterator[PartialFrame]:
        for t in range(start, self.num_frames if stop is None else stop):
            yield PartialFrame(t, tuple(clip[t] for clip in self.clips))


def filmed(clips: Clips, fps: float = FPS) -> Filmed:
    """Return the capture of one clip per camera, of the first ones of the rig."""
    none = np.zeros((0, 3), np.float32)
    capture = Filmed(
        *(Path("filmed"), tuple(rig()[: len(clips)]), len(clips[0]), fps, none, none),
        masks=(None,) * len(clips),
        test_views=(),
        truth=None,
        _sources=(),
    )
    object.__setattr__(capture, "clips", clips)
    return capture


def rig() -> list[Camera]:
    """Return four small cameras."""
    return [camera.resized(200, 150) for camera in textured.rig(COUNT)]


def film(offsets: Sequence[float] = (0.0,) * COUNT, frames: int = 32) -> Clips:
    """Return the clip of each camera with its time offset in frames."""
    planes = textured.textures()
    clips = []
    for camera, offset in zip(rig(), offsets, strict=True):
        still = textured.render(camera, planes)
        times = offset + np.arange(frames)
        clips.append([textured.render(camera, planes[:2], _moving(t), still) for t in times])
    return clips


def _moving(t: float) -> list[tuple]:
    """Return the places of the moving planes at frame t."""
    x = 0.9 * np.sin(0.21 * t)
    y = 0.6 * np.sin(0.33 * t + 0.5)
    return [
        ((x - 0.3, y - 0.6, 3.2), (0.5, 0, 0), (0, 0.5, 0)),
        ((0.1 - y, 0.5 * x, 2.6), (0.3, 0, 0), (0, 0.4, 0)),
    ]

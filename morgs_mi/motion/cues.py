"""What the key views say about a frame: motion where it can be trusted, and masks at keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.motion.config import MotionConfig
from morgs_mi.motion.flow import motion_cue
from morgs_mi.motion.masks import motion_mask

__all__ = ["MotionCue", "choose_key_views", "motion_cues"]


@dataclass(frozen=True, eq=False)
class MotionCue:
    """One key view's evidence at one frame.

    Attributes:
        motion: x_t - x_{t-1} [H, W, 2] in px on frame t's grid.
        reliable: [H, W] bool, where forward and backward flow agree.
        mask: what moves [H, W] bool (eq. 10), or None where it was not asked for.
    """

    motion: np.ndarray
    reliable: np.ndarray
    mask: np.ndarray | None = None


def choose_key_views(cameras: Sequence[Camera], count: int) -> tuple[int, ...]:
    """Return `count` views spread over the rig: the most central one, then always the farthest from those chosen."""
    positions = np.array([camera.position for camera in cameras])
    chosen = [int(np.argmin(np.linalg.norm(positions - positions.mean(0), axis=1)))]
    while len(chosen) < min(count, len(cameras)):
        gap = np.linalg.norm(positions[:, None] - positions[chosen], axis=-1).min(1)
        chosen.append(int(np.argmax(gap)))
    return tuple(sorted(chosen))


def motion_cues(
    images: Sequence[np.ndarray],
    previous: Sequence[np.ndarray],
    views: Sequence[int],
    config: MotionConfig,
    with_masks: bool,
    valid: Sequence[np.ndarray | None],
) -> Mapping[int, MotionCue]:
    """Return the cue of every key view (eq. 4, and 9 and 10 for the masks).

    Args:
        images: frame t of all views, uint8 [H, W, 3].
        previous: frame t - 1 of all views; frame t + 1 with the sign of motion reversed is the caller's affair.
        views: the key views.
        config: flow method.
        with_masks: whether masks are wanted.
        valid: per view [H, W] bool, False where undistortion left nothing; None: valid everywhere.
    """
    cues = {}
    for view in views:
        motion, reliable = motion_cue(images[view], previous[view], config.flow_method)
        inside = valid[view]
        if inside is not None:
            reliable = reliable & inside
        mask = motion_mask(images[view], motion, reliable) if with_masks else None
        cues[view] = MotionCue(motion, reliable, mask)
    return cues

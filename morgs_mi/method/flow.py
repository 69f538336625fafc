"""What the key views say about a frame: motion where it can be trusted, and masks at keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow_sources.consistency import consistency_mask
from morgs_mi.method.flow_sources.registry import FlowSource, FramePair, flow_source

__all__ = ["FlowObservation", "choose_key_views", "observe_flow", "observe_key_views"]


@dataclass(frozen=True, eq=False)
class FlowObservation:
    """One key view's evidence at one frame.

    Attributes:
        motion: x_t - x_{t-1} [H, W, 2] in px on frame t's grid.
        reliable: [H, W] bool, where the flow there and back agree.
        forward_flow: x_t - x_{t-1} again, but on frame t - 1's grid [H, W, 2].
        forward_reliable: [H, W] bool, likewise.
        mask: what moves [H, W] bool (eq. 10), or None where it was not asked for.
    """

    motion: np.ndarray
    reliable: np.ndarray
    forward_flow: np.ndarray
    forward_reliable: np.ndarray
    mask: np.ndarray | None = None


def choose_key_views(cameras: Sequence[Camera], count: int) -> tuple[int, ...]:
    """Return `count` views spread over the rig: the most central one, then always the farthest from those chosen."""
    positions = np.array([camera.position for camera in cameras])
    chosen = [int(np.argmin(np.linalg.norm(positions - positions.mean(0), axis=1)))]
    while len(chosen) < min(count, len(cameras)):
        gap = np.linalg.norm(positions[:, None] - positions[chosen], axis=-1).min(1)
        chosen.append(int(np.argmax(gap)))
    return tuple(sorted(chosen))


def observe_flow(
    image: np.ndarray,
    previous: np.ndarray,
    method: str = "dis",
    mask_method: str | None = None,
    valid: np.ndarray | None = None,
) -> FlowObservation:
    """Return the cue of two pictures, whichever camera's they are.

    Args:
        image: I_t [H, W, 3], RGB, uint8 or float in [0, 1].
        previous: I_{t-1}, likewise.
        method: as `flow_source` takes it.
        mask_method: as `mask_refiner` takes it; None: no mask is wanted.
        valid: [H, W] bool, False where undistortion left nothing; None: valid everywhere.

    Raises:
        ValueError: as `flow_source`, `optical_flow` and `mask_refiner`.
    """
    return _cue(FramePair(np.asarray(image), np.asarray(previous), valid=valid), flow_source(method), mask_method)


def observe_key_views(
    pairs: Mapping[int, FramePair], config: MotionConfig, with_masks: bool
) -> dict[int, FlowObservation]:
    """Return the cue of every key view from its two pictures, by view.

    Raises:
        OSError: flow that is read from files is missing.
        ValueError: as `flow_source`, `mask_refiner` and what they name.
    """
    source = flow_source(config.flow_method)
    mask_method = config.mask_method if with_masks else None
    return {view: _cue(pair, source, mask_method) for view, pair in pairs.items()}


def _cue(pair: FramePair, source: FlowSource, mask_method: str | None) -> FlowObservation:
    """Return one view's cue (eq. 4, and 9 and 10 for the mask), from optical flow both ways."""
    flow, forward_flow = source(pair)
    reliable, forward_reliable = consistency_mask(flow, forward_flow), consistency_mask(forward_flow, flow)
    known = pair.valid
    if pair.box is not None:
        known = np.zeros(reliable.shape, bool)
        known[pair.box] = True if pair.valid is None else pair.valid[pair.box]
    if known is not None:
        reliable, forward_reliable = reliable & known, forward_reliable & known
    mask = motion_mask(pair.image, -flow, reliable, mask_method) if mask_method else None
    return FlowObservation(-flow, reliable, forward_flow, forward_reliable, mask)

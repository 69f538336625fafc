"""Optical flow of the key views (eq. 4), checked forward and backward, and the motion masks that
follow from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.threads import map_in_threads
from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.flow_sources.consistency import consistency_mask
from morgs_mi.method.flow_sources.flow_config import FlowConfig
from morgs_mi.method.flow_sources.flow_registry import FlowSource, FramePair, flow_source
from morgs_mi.method.mask_refiners.mask_config import MaskConfig


@dataclass(frozen=True, eq=False)
class FlowObservation:
    """Optical flow of one key view at one frame."""

    #: x_t - x_{t-1} [H, W, 2] in px on frame t's grid: the negative of the flow to frame t - 1.
    motion: np.ndarray
    reliable: np.ndarray  #: [H, W] bool, where forward and backward flow agree.
    #: x_t - x_{t-1} [H, W, 2] in px on frame t - 1's grid: the flow to frame t.
    forward_flow: np.ndarray
    forward_reliable: np.ndarray  #: [H, W] bool, likewise.
    #: Motion mask [H, W] bool (eq. 10), or None if it was not requested.
    mask: np.ndarray | None = None


def observe_key_views(
    pairs: Mapping[int, FramePair],
    method: str = "dis",
    mask_method: str | None = None,
    flow: FlowConfig | None = None,
    masks: MaskConfig | None = None,
) -> dict[int, FlowObservation]:
    """Return the flow observation of each pair of images, by view index.

    Args:
        pairs: images of the key views at two frames, by view index.
        method: source of the flow, see `flow_source`.
        mask_method: refinement of the masks, see `mask_refiner`; None: no masks.
        flow: settings of the flow and of its check.
        masks: settings of the masks.

    Raises:
        OSError: flow is read from files and one is missing.
        ValueError: as `flow_source` and `mask_refiner`.
    """
    source = flow_source(method, flow)
    flows = map_in_threads(lambda pair: _checked_flow(source, pair, flow), pairs.values())
    observations = dict(zip(pairs, flows, strict=True))
    if not mask_method:
        return observations
    # Eqs. 9 and 10.
    return {
        v: replace(o, mask=motion_mask(pairs[v].image, o.motion, o.reliable, mask_method, masks))
        for v, o in observations.items()
    }


def _checked_flow(
    source: FlowSource, pair: FramePair, config: FlowConfig | None
) -> FlowObservation:
    """Return the backward flow (eq. 4), the forward flow, and where each is reliable."""
    backward, forward = source(pair)
    reliable, forward_reliable = _reliable(pair, backward, forward, config)
    if pair.region is not None:
        # Flow bleeds over the edges of moving objects; unchanged pixels have not moved.
        backward, forward = (np.where(pair.region[..., None], f, 0) for f in (backward, forward))
        still = ~pair.region if pair.valid is None else ~pair.region & pair.valid
        reliable = reliable | still
        forward_reliable = forward_reliable | still
    return FlowObservation(-backward, reliable, forward, forward_reliable)


def _reliable(
    pair: FramePair, backward: np.ndarray, forward: np.ndarray, config: FlowConfig | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return where the backward flow and where the forward flow is reliable, bool [H, W] each."""
    reliable, forward_reliable = (
        consistency_mask(*flows, config) for flows in ((backward, forward), (forward, backward))
    )
    valid = _valid_in_box(pair, reliable.shape)
    if valid is None:
        return reliable, forward_reliable
    return reliable & valid, forward_reliable & valid


def _valid_in_box(pair: FramePair, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return the valid pixels inside the box of a pair, bool [H, W]; None if all are."""
    if pair.box is None:
        return pair.valid
    valid = np.zeros(shape, bool)
    valid[pair.box] = True if pair.valid is None else pair.valid[pair.box]
    return valid

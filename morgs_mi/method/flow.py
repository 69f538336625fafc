"""Optical flow of the key views (eq. 4), checked forward and backward, and the motion masks that
follow from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morgs_mi.method.confidence import motion_mask
from morgs_mi.method.flow_sources.flow_registry import (
    FLOW_SOURCES,
    FlowConfig,
    FlowSource,
    FramePair,
)
from morgs_mi.method.mask_refiners.mask_registry import MaskConfig
from morgs_mi.platform.checks import valid_pixels
from morgs_mi.platform.threads import map_in_threads
from morgs_mi.render.active_view import ActiveView

# Tolerated squared mismatch of the flows forth and back, as a share of their squared lengths, and
# of the shortest flows, px^2 (Sundaram, Brox and Keutzer, ECCV 2010).
RELATIVE_TOLERANCE = 0.01
ABSOLUTE_TOLERANCE = 0.5


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


@dataclass(frozen=True, eq=False)
class ViewFlow:
    """An active view with its optical flow."""

    view: ActiveView  #: The view.
    flow: FlowObservation  #: The flow of its whole image.


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
        method: source of the flow, see `FLOW_SOURCES`.
        mask_method: refinement of the masks, see `MASK_REFINERS`; None: no masks.
        flow: settings of the flow.
        masks: settings of the masks.

    Raises:
        OSError: flow is read from files and one is missing.
        ValueError: a method is not registered, or as its factory.
    """
    source = FLOW_SOURCES.make(method, flow)
    observations = dict(map_in_threads(lambda v: (v, _checked_flow(source, pairs[v])), pairs))
    if not mask_method:
        return observations
    # Eqs. 9 and 10.
    return {
        v: replace(
            o,
            mask=motion_mask(
                pairs[v].image, o.motion, o.reliable, mask_method, masks or MaskConfig()
            ),
        )
        for v, o in observations.items()
    }


def _checked_flow(source: FlowSource, pair: FramePair) -> FlowObservation:
    """Return the backward flow (eq. 4), the forward flow, and where each is reliable."""
    box = pair.box or np.s_[:, :]
    shape = pair.image.shape[:2]
    valid = valid_pixels(pair.valid, shape)
    # Flow bleeds over the edges of moving objects; unchanged pixels have not moved.
    moves = np.ones(shape, bool) if pair.region is None else pair.region

    def checked(flow: np.ndarray, back: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a flow of the box in the whole image, and where it is reliable."""
        reliable = valid & ~moves
        reliable[box] |= valid[box] & consistency_mask(flow, back)
        image = np.zeros((*shape, 2), np.float32)
        image[box] = np.where(moves[box][..., None], flow, 0)
        return image, reliable

    to_previous, to_next = (flow[box] for flow in source(pair))
    backward, reliable = checked(to_previous, to_next)
    forward, forward_reliable = checked(to_next, to_previous)
    return FlowObservation(-backward, reliable, forward, forward_reliable)


def consistency_mask(flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return the mask of reliable flow [H, W], bool: pixels that the flow back returns to where
    they started.

    |F + B|^2 < 0.01 (|F|^2 + |B|^2) + 0.5 px^2, with B sampled at x + F(x) (Sundaram, Brox and
    Keutzer, ECCV 2010). Pixels that become hidden or leave the image fail.

    Args:
        flow: F [H, W, 2] in pixels, from one frame to another.
        back: B [H, W, 2], from the other frame to the first, on the other frame's grid.
    """
    height, width = flow.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x = x + flow[..., 0]
    y = y + flow[..., 1]
    back = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lengths = _squares(flow) + _squares(back)
    limit = RELATIVE_TOLERANCE * lengths + ABSOLUTE_TOLERANCE
    # An image ends half a pixel beyond the outermost centres, so the flow's own error does not
    # reject the border.
    is_within = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    return is_within & (_squares(flow + back) < limit)


def _squares(vectors: np.ndarray) -> np.ndarray:
    """Return the squared lengths [H, W] of vectors [H, W, 2]."""
    return np.einsum("hwc,hwc->hw", vectors, vectors)

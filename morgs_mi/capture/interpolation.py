"""Interpolation of images between two frames of a clip by optical flow, at the time of another
camera's frame.

A point that moves by the flow F from the first frame to the second has moved by s F at the share s
of the time between them. So the pixel x shows the point p of the first frame with p + s F(p) = x,
and the point q of the second frame with q + (1 - s) B(q) = x, with B the flow back. Both are found
by fixed-point iteration, and their colours are averaged with the weights 1 - s and s. A point with
unreliable flow, because the other frame does not show it, has a small weight.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.method.flow import consistency_mask
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FramePair

# Rounds of the fixed-point iteration: flow is smooth, so each round gains about a digit.
_ROUNDS = 5
# Weight of an unreliable point: it matters only where neither frame has a reliable one.
_LEAST_WEIGHT = 1e-3


class FrameInterpolation:
    """The images between a frame of a clip and the next one. Their flow is computed once.

    Args:
        first: [H, W, 3], RGB: uint8, or float32 of linear light.
        second: likewise, of the same size and type.
    """

    def __init__(self, first: np.ndarray, second: np.ndarray) -> None:
        self.frames = (first, second)
        self._has_light = first.dtype != np.uint8

    def at(self, share: float) -> np.ndarray:
        """Return the image at a share of the time between the frames [H, W, 3].

        Args:
            share: in [0, 1]; 0 for the first frame, 1 for the second.
        """
        if share in (0, 1):
            return self.frames[round(share)]
        forward, backward = self._flows
        first, second = self._encoded
        first, first_weight = _contribution(first, forward, backward, share)
        second, second_weight = _contribution(second, backward, forward, 1 - share)
        mean = (first + second) / (first_weight + second_weight)
        if self._has_light:
            return np.maximum(decode_light(mean), 0)
        return np.clip(np.rint(mean), 0, 255).astype(np.uint8)

    @property
    def _encoded(self) -> tuple[np.ndarray, np.ndarray]:
        """The frames [H, W, 3]; linear light is encoded."""
        first, second = self.frames
        return (encode_light(first), encode_light(second)) if self._has_light else self.frames

    @cached_property
    def _flows(self) -> tuple[np.ndarray, np.ndarray]:
        """The flow from the first frame to the second [H, W, 2], and back."""
        first, second = self._encoded
        if self._has_light:
            first = np.clip(first, 0, 1)
            second = np.clip(second, 0, 1)
        backward, forward = FLOW_SOURCES.make("dis")(FramePair(second, first))
        return forward, backward


def _contribution(
    image: np.ndarray, flow: np.ndarray, back: np.ndarray, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame moved by a share of its flow, multiplied by its weights, and the weights."""
    pixels = np.stack(
        np.meshgrid(*(np.arange(n, dtype=np.float32) for n in flow.shape[1::-1])), axis=-1
    )
    places = pixels  # the points p of the frame with p + share flow(p) = x for every pixel x
    for _ in range(_ROUNDS):
        places = pixels - np.float32(share) * _sampled(flow, places, cv2.INTER_LINEAR)
    reliable = _sampled(consistency_mask(flow, back).astype(np.float32), places, cv2.INTER_LINEAR)
    weights = np.float32(1 - share) * (reliable[..., None] + np.float32(_LEAST_WEIGHT))
    return weights * _sampled(image.astype(np.float32), places, cv2.INTER_CUBIC), weights


def _sampled(image: np.ndarray, places: np.ndarray, how: int) -> np.ndarray:
    """Return the values of an image [H, W, ...] at positions [H, W, 2] in pixels."""
    x = np.ascontiguousarray(places[..., 0])
    y = np.ascontiguousarray(places[..., 1])
    return cv2.remap(image, x, y, how, borderMode=cv2.BORDER_REPLICATE)

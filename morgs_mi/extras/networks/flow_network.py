"""Optical flow from a trained network in an ONNX file, run by `onnxruntime`.

The network takes two images [1, 3, H, W], RGB, and returns the flow [1, 2, H, W] in pixels from the
first to the second, like RAFT (Teed and Deng, ECCV 2020), SEA-RAFT (Wang, Lipson and Deng, ECCV
2024) and similar networks. It may have other outputs, such as RAFT's flow at an eighth of the size.

If the network leaves H and W open, the images are padded to multiples of 8 by repeating their
border, and the padding is cropped from the flow. If it fixes them, the images are resized, and the
flow is resized back and scaled by the same factors.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morgs_mi.core.color_space import unit_values
from morgs_mi.io.onnx_file import OnnxNetwork, written_shapes
from morgs_mi.method.flow_sources.flow_registry import FlowConfig, FlowSource, both_directions
from morgs_mi.platform.checks import require

# RAFT and similar networks halve the size three times.
MULTIPLE = 8


class FlowNetwork:
    """Flow network: called with two images, it returns the flow from the first to the second.

    Args:
        path: the ONNX file.
        low: the network's value of black.
        high: the network's value of white.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: `onnxruntime` is not installed or cannot load it, or it does not take two
            images.
    """

    def __init__(self, path: str | Path, low: float = 0.0, high: float = 255.0) -> None:
        self.path = Path(path)
        self.low = low
        self.high = high
        self._net = OnnxNetwork(path)
        shapes = list(self._net.inputs.values())
        first: Any = shapes[0] if shapes else ()
        is_image = len(first) == 4 and first[0] in (1, None) and first[1] in (3, None)
        require(
            is_image and shapes == [first] * 2 and (first[2] is None) == (first[3] is None),
            path,
            "expected two images [1, 3, H, W] as inputs, H and W both fixed or both open",
            written_shapes(shapes),
            "export it with one input per image",
        )
        height, width = first[2:]
        self._size = None if height is None else (width, height)

    def __call__(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the flow [H, W, 2] in pixels, float32, from `image` to `other` on the grid of
        `image`.

        Args:
            image: [H, W, 3], RGB, uint8 or float in [0, 1].
            other: likewise.

        Raises:
            ValueError: the network cannot run at this size, or does not return a flow.
        """
        height, width = image.shape[:2]
        pair = (image, other)
        if self._size is None:
            down = -height % MULTIPLE
            right = -width % MULTIPLE
            top = down // 2
            left = right // 2
            border = (top, down - top, left, right - left, cv2.BORDER_REPLICATE)
            padded_flow = self._run(*(cv2.copyMakeBorder(each, *border) for each in pair))
            flow = padded_flow[top : top + height, left : left + width]
        else:
            images = (cv2.resize(each, self._size, interpolation=cv2.INTER_AREA) for each in pair)
            flow = cv2.resize(self._run(*images), (width, height), interpolation=cv2.INTER_LINEAR)
            flow = flow * np.array((width / self._size[0], height / self._size[1]), np.float32)
        return flow

    def _run(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the network's flow [H, W, 2] between two images of a size that it takes."""
        blobs: dict[str, np.ndarray] = {}
        for name, each in zip(self._net.inputs, (image, other), strict=True):
            values = self.low + (self.high - self.low) * unit_values(each, np.float32)
            blobs[name] = np.ascontiguousarray(np.moveaxis(values, 2, 0)[None], np.float32)
        outputs = self._net.run(blobs).values()
        shape = (1, 2, *image.shape[:2])
        # A network that returns the flow of each of its iterations returns the best one last.
        flows = [output for output in outputs if output.shape == shape]
        require(
            flows,
            self.path,
            f"expected an output {[*shape]}, the flow",
            written_shapes(output.shape for output in outputs),
            "export another network",
        )
        return np.ascontiguousarray(np.moveaxis(flows[-1][0], 0, 2), dtype=np.float32)


def _source(low: float, high: float, path: str, config: FlowConfig) -> FlowSource:
    return both_directions(FlowNetwork(path, low, high))


onnx = partial(_source, 0, 255)
"""Flow source of a network that takes values from 0 to 255, as RAFT's and SEA-RAFT's own code."""

onnx_unit = partial(_source, 0, 1)
"""Flow source of a network that takes values from 0 to 1."""

onnx_signed = partial(_source, -1, 1)
"""Flow source of a network that takes values from -1 to 1, as torchvision's RAFT does."""

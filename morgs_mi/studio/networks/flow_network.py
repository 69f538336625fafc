"""Optical flow from a trained network in an ONNX file, run by `onnxruntime`.

The network takes two images [1, 3, H, W], RGB, and returns the flow [1, 2, H, W] in pixels from the
first to the second, like RAFT (Teed and Deng, ECCV 2020), SEA-RAFT (Wang, Lipson and Deng, ECCV
2024) and similar networks. It may have other outputs, such as RAFT's flow at an eighth of the size.

If the network leaves H and W open, the images are padded to multiples of 8 by repeating their
border, and the padding is cropped from the flow. If it fixes them, the images are resized, and the
flow is resized back and scaled by the same factors.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from morgs_mi.core.color_space import unit_values
from morgs_mi.method.flow_sources.flow_config import FlowConfig
from morgs_mi.method.flow_sources.flow_registry import FlowSource, both_directions
from morgs_mi.studio.networks.onnx_file import OnnxNetwork, written_shapes

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
        self._net = OnnxNetwork(path, " or use its flow from files")
        self._size = _image_size(path, list(self._net.inputs.values()))

    def __call__(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the flow [H, W, 2] in pixels, float32, from `image` to `other` on the grid of
        `image`.

        Args:
            image: [H, W, 3], RGB, uint8 or float in [0, 1].
            other: likewise.

        Raises:
            ValueError: the network cannot run at this size, or does not return a flow.
        """
        size = self._size
        flow = self._padded(image, other) if size is None else self._resized(image, other, size)
        if not np.isfinite(flow).all():
            raise ValueError(
                f"{self.path}: expected a finite flow, got NaN or infinity; check the value range."
            )
        return flow

    def _padded(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        down = -height % MULTIPLE
        right = -width % MULTIPLE
        top = down // 2
        left = right // 2
        images = (
            cv2.copyMakeBorder(each, top, down - top, left, right - left, cv2.BORDER_REPLICATE)
            for each in (image, other)
        )
        return self._run(*images)[top : top + height, left : left + width]

    def _resized(self, image: np.ndarray, other: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        height, width = image.shape[:2]
        images = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (image, other))
        flow = cv2.resize(self._run(*images), (width, height), interpolation=cv2.INTER_LINEAR)
        return flow * np.array((width / size[0], height / size[1]), np.float32)

    def _run(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        blobs = (self._blob(each) for each in (image, other))
        outputs = self._net.run(dict(zip(self._net.inputs, blobs, strict=True))).values()
        flow = _last_flow(self.path, list(outputs), (1, 2, height, width))
        return np.ascontiguousarray(np.moveaxis(flow[0], 0, 2), dtype=np.float32)

    def _blob(self, image: np.ndarray) -> np.ndarray:
        """Return an image as the network's input, [1, 3, H, W] float32."""
        unit = unit_values(image, np.float32)
        return np.ascontiguousarray(
            np.moveaxis(self.low + (self.high - self.low) * unit, 2, 0)[None], np.float32
        )


def _last_flow(path: Path, outputs: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Return the last output of a network that has the shape of a flow."""
    # A network that returns the flow of each of its iterations returns the best one last.
    flows = [output for output in outputs if output.shape == shape]
    if not flows:
        shapes = written_shapes([output.shape for output in outputs])
        raise ValueError(f"{path}: expected an output {[*shape]}, the flow, got {shapes}.")
    return flows[-1]


def _is_image(shape: tuple[int | None, ...]) -> bool:
    return len(shape) == 4 and shape[0] in (1, None) and shape[1] in (3, None)


def _image_size(
    path: str | Path, shapes: Sequence[tuple[int | None, ...]]
) -> tuple[int, int] | None:
    """Return the width and height of a network's two images, None if it takes any size."""
    if len(shapes) != 2 or not all(map(_is_image, shapes)) or shapes[0] != shapes[1]:
        raise ValueError(
            f"{path}: expected a network with two images [1, 3, H, W] as its inputs, got "
            f"{written_shapes(shapes)}; export it with one input per image."
        )
    height, width = shapes[0][2:]
    if (height is None) != (width is None):
        raise ValueError(
            f"{path}: expected height and width both fixed or both open, got "
            f"{written_shapes(shapes[:1])}."
        )
    return None if height is None or width is None else (width, height)


def onnx(path: str, config: FlowConfig) -> FlowSource:
    """Return the flow source of a network that takes values from 0 to 255, as RAFT's and SEA-RAFT's
    own code does.
    """
    return both_directions(FlowNetwork(path, 0, 255))


def onnx_unit(path: str, config: FlowConfig) -> FlowSource:
    """Return the flow source of a network that takes values from 0 to 1."""
    return both_directions(FlowNetwork(path, 0, 1))


def onnx_signed(path: str, config: FlowConfig) -> FlowSource:
    """Return the flow source of a network that takes values from -1 to 1, as torchvision's RAFT
    does.
    """
    return both_directions(FlowNetwork(path, -1, 1))

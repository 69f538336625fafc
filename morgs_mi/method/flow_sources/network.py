"""Optical flow from a trained network in an ONNX file, run by `cv2.dnn`.

The network takes two images [1, 3, H, W], RGB, and returns the flow [1, 2, H, W] in pixels from the first to the
second, like RAFT (Teed and Deng, ECCV 2020), SEA-RAFT (Wang, Lipson and Deng, ECCV 2024) and similar networks. It may
have other outputs, such as RAFT's flow at an eighth of the size.

If the network leaves H and W open, the images are padded to multiples of 8 by repeating their border, and the padding
is cropped from the flow. If it fixes them, the images are resized, and the flow is resized back and scaled by the same
factors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock

import cv2
import numpy as np

from morgs_mi.method.flow_sources.config import FlowConfig
from morgs_mi.method.flow_sources.registry import FLOW_SOURCES, FlowSource, both_directions

__all__ = ["VALUE_RANGES", "FlowNetwork", "Signature", "read_signature"]

# Values of black and white. RAFT's and SEA-RAFT's own code takes bytes and normalises inside; torchvision's RAFT takes
# -1 to 1.
VALUE_RANGES = {"onnx": (0.0, 255.0), "onnx-unit": (0.0, 1.0), "onnx-signed": (-1.0, 1.0)}
# RAFT and similar networks halve the size three times.
_MULTIPLE = 8


@dataclass(frozen=True)
class Signature:
    """Inputs and outputs of a network.

    Attributes:
        inputs: shape of each input by name; None for a size that the network leaves open.
        outputs: names of the outputs.
    """

    inputs: dict[str, tuple[int | None, ...]]
    outputs: tuple[str, ...]


class FlowNetwork:
    """Flow network: called with two images, it returns the flow from the first to the second.

    Args:
        path: the ONNX file.
        low: the network's value of black.
        high: the network's value of white.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not an ONNX file, OpenCV cannot run it, or it does not take two images.
    """

    def __init__(self, path: str | Path, low: float = 0.0, high: float = 255.0) -> None:
        self.path, self.low, self.high = Path(path), low, high
        self._lock = Lock()  # several views are run from several threads
        self.signature = read_signature(path)
        shapes = list(self.signature.inputs.values())
        images = all(len(s) == 4 and s[0] in (1, None) and s[1] in (3, None) for s in shapes)
        if len(shapes) != 2 or not images or shapes[0] != shapes[1]:
            raise ValueError(
                f"{path}: expected a network with two images [1, 3, H, W] as its inputs, got {_written(shapes)}; "
                "export it with one input per image."
            )
        height, width = shapes[0][2:]
        if (height is None) != (width is None):
            raise ValueError(f"{path}: expected height and width both fixed or both open, got {_written(shapes[:1])}.")
        self._size = None if height is None or width is None else (width, height)
        try:
            self._net = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            raise ValueError(
                f"{path}: OpenCV {cv2.__version__} cannot load this network ({_reason(error)}); export it with other "
                "operators or use its flow from files."
            ) from error

    def __call__(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the flow [H, W, 2] in pixels, float32, from `image` to `other` on the grid of `image`.

        Args:
            image: [H, W, 3], RGB, uint8 or float in [0, 1].
            other: likewise.

        Raises:
            ValueError: the network cannot run at this size, or does not return a flow.
        """
        height, width = image.shape[:2]
        if self._size is None:
            flow = self._padded(image, other)
        else:
            image, other = (cv2.resize(each, self._size, interpolation=cv2.INTER_AREA) for each in (image, other))
            flow = cv2.resize(self._run(image, other), (width, height), interpolation=cv2.INTER_LINEAR)
            flow = flow * np.array((width / self._size[0], height / self._size[1]), np.float32)
        if not np.isfinite(flow).all():
            raise ValueError(f"{self.path}: expected a finite flow, got NaN or infinity; check the value range.")
        return flow

    def _padded(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        down, right = -height % _MULTIPLE, -width % _MULTIPLE
        top, left = down // 2, right // 2
        padded = (
            cv2.copyMakeBorder(each, top, down - top, left, right - left, cv2.BORDER_REPLICATE)
            for each in (image, other)
        )
        return self._run(*padded)[top : top + height, left : left + width]

    def _run(self, image: np.ndarray, other: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        try:
            with self._lock:
                for name, each in zip(self.signature.inputs, (image, other), strict=True):
                    self._net.setInput(self._blob(each), name)
                outputs = self._net.forward(list(self.signature.outputs))
        except cv2.error as error:
            raise ValueError(
                f"{self.path}: OpenCV {cv2.__version__} cannot run this network on {width}x{height} pixels "
                f"({_reason(error)}); export it for this size or use its flow from files."
            ) from error
        # A network that returns the flow of each of its iterations returns the best one last.
        flows = [output for output in outputs if output.shape == (1, 2, height, width)]
        if not flows:
            shapes = _written([output.shape for output in outputs])
            raise ValueError(f"{self.path}: expected an output [1, 2, {height}, {width}], the flow, got {shapes}.")
        return np.ascontiguousarray(np.moveaxis(flows[-1][0], 0, 2), dtype=np.float32)

    def _blob(self, image: np.ndarray) -> np.ndarray:
        """Return an image as the network's input, [1, 3, H, W] float32."""
        unit = image.astype(np.float32) / (255 if image.dtype == np.uint8 else 1)
        return np.ascontiguousarray(np.moveaxis(self.low + (self.high - self.low) * unit, 2, 0)[None], np.float32)


def read_signature(path: str | Path) -> Signature:
    """Return the inputs and outputs of the network in an ONNX file, which `cv2.dnn` does not report.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not an ONNX file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: expected an ONNX file, found none; check the path.")
    try:
        # Field numbers are those of onnx.proto: ModelProto.graph; GraphProto.initializer, .input and .output.
        graph = next(_fields(memoryview(Path(path).read_bytes()), 7))
        weights = {_text(next(_fields(tensor, 8))) for tensor in _fields(graph, 5)}
        inputs = {_text(next(_fields(value, 1))): _shape(value) for value in _fields(graph, 11)}
        outputs = tuple(_text(next(_fields(value, 1))) for value in _fields(graph, 12))
    except (StopIteration, IndexError, ValueError) as error:
        raise ValueError(f"{path}: expected an ONNX file, got another format; export the network again.") from error
    return Signature({name: shape for name, shape in inputs.items() if name not in weights}, outputs)


def _shape(value: memoryview) -> tuple[int | None, ...]:
    """Return the shape in a ValueInfoProto: type, tensor_type, shape, its dims, and their dim_value if there is one."""
    shape = next(_fields(next(_fields(next(_fields(value, 2)), 1)), 2), memoryview(b""))
    return tuple(next(_fields(size, 1), None) or None for size in _fields(shape, 1))


def _fields(message: memoryview, wanted: int) -> Iterator:
    """Yield the values of one field of a protobuf message: bytes, or an int for a varint."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        kind, value = key & 7, None
        if kind == 0:
            value, at = _varint(message, at)
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        elif kind == 2:
            length, at = _varint(message, at)
            value, at = message[at : at + length], at + length
        else:
            raise ValueError("not a protobuf message")
        if at > len(message):
            raise ValueError("cut short")
        if key >> 3 == wanted:
            yield value


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = message[at]
        value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
        if byte < 128:
            return value, at


def _make(kind: str, path: str, config: FlowConfig) -> FlowSource:
    return both_directions(FlowNetwork(path, *VALUE_RANGES[kind]))


for _kind in VALUE_RANGES:
    FLOW_SOURCES.register(_kind, "FILE")(partial(_make, _kind))


def _text(value: memoryview) -> str:
    return bytes(value).decode()


def _written(shapes: list[tuple]) -> str:
    written = ("[" + ", ".join("?" if size is None else str(size) for size in shape) + "]" for shape in shapes)
    return " and ".join(written) or "none"


def _reason(error: cv2.error) -> str:
    return " ".join(str(error).split("error: ")[-1].split())

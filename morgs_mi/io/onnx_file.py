"""Networks in ONNX files, run by `cv2.dnn`: their signature, their input and their output."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import cv2
import numpy as np

__all__ = ["OnnxNetwork", "Signature", "imagenet_blob", "read_signature", "written_shapes"]

# Mean and standard deviation of ImageNet's colours, by which most networks for images normalise their input.
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)


@dataclass(frozen=True)
class Signature:
    """Inputs and outputs of a network.

    Attributes:
        inputs: shape of each input by name; None for a size that the network leaves open.
        outputs: names of the outputs.
    """

    inputs: dict[str, tuple[int | None, ...]]
    outputs: tuple[str, ...]


class OnnxNetwork:
    """Network in `cv2.dnn`, which several threads may share.

    Args:
        path: the ONNX file.
        signature: its inputs and outputs, as `read_signature` returns them.
        instead: what error messages name as another way, e.g. " or use its flow from files".

    Raises:
        ValueError: OpenCV cannot load the network.
    """

    def __init__(self, path: str | Path, signature: Signature, instead: str = "") -> None:
        self.path, self.signature, self._instead, self._lock = path, signature, instead, Lock()
        try:
            self._net = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            raise ValueError(
                f"{path}: OpenCV {cv2.__version__} cannot load this network ({_reason(error)}); export it with other "
                f"operators{instead}."
            ) from error

    def run(self, inputs: Mapping[str, np.ndarray]) -> Sequence[np.ndarray]:
        """Return all outputs in their order.

        Args:
            inputs: by name, [1, C, H, W] float32, all of one size.

        Raises:
            ValueError: OpenCV cannot run the network on them.
        """
        height, width = next(iter(inputs.values())).shape[2:]
        try:
            with self._lock:
                for name, value in inputs.items():
                    self._net.setInput(value, name)
                return self._net.forward(list(self.signature.outputs))
        except cv2.error as error:
            raise ValueError(
                f"{self.path}: OpenCV {cv2.__version__} cannot run this network on {width}x{height} pixels "
                f"({_reason(error)}); export it for this size{self._instead}."
            ) from error


def imagenet_blob(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return an image as a network's input [1, 3, height, width] float32, normalised by ImageNet's colours.

    Args:
        image: [H, W, 3], RGB, uint8 or float in [0, 1]; it is stretched to the size.
        width: of the input.
        height: of the input.
    """
    unit = image.astype(np.float32) / (255 if image.dtype == np.uint8 else 1)
    shrinks = image.shape[1] > width
    unit = cv2.resize(unit, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.ascontiguousarray(np.moveaxis((unit - _MEAN) / _DEVIATION, 2, 0)[None])


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


def written_shapes(shapes: list[tuple]) -> str:
    """Return shapes as in an error message, with ? for a size that is left open."""
    written = ("[" + ", ".join("?" if size is None else str(size) for size in shape) + "]" for shape in shapes)
    return " and ".join(written) or "none"


def _text(value: memoryview) -> str:
    return bytes(value).decode()


def _reason(error: cv2.error) -> str:
    return " ".join(str(error).split("error: ")[-1].split())

"""Networks in ONNX files, run on the CPU by `onnxruntime`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morgs_mi.core.color_space import unit_values
from morgs_mi.core.types import Arrays
from morgs_mi.io.listing import existing_file
from morgs_mi.platform.checks import kind_of, require

# Mean and standard deviation of ImageNet's colours, by which most networks for images normalise
# their input.
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
# Largest input that a file may fix: an image of 4096 x 4096, to which smaller ones would be
# enlarged.
_MAX_VALUES = 3 * 4096**2
# Of its own messages, `onnxruntime` prints only those before it ends the process: errors are
# raised.
_FATAL = 4


class OnnxNetwork:
    """Network in an ONNX file, which several threads may share.

    Weights in further files are read only from the folder of the network, which `onnxruntime`
    checks.

    Args:
        path: the ONNX file.

    Attributes:
        path: the ONNX file.
        inputs: shape of each input by name; None for a size that the network leaves open.
        outputs: names of the outputs.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: `onnxruntime` is not installed or cannot load the network, or an input has too
            many values.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = existing_file(path, "an ONNX file")
        try:
            import onnxruntime
        except ImportError:
            raise ValueError(
                f"{path}: running a network needs the package onnxruntime; pip install "
                "'morgs-mi[networks]'."
            ) from None
        self._runtime = f"onnxruntime {onnxruntime.__version__}"
        options = onnxruntime.SessionOptions()
        options.log_severity_level = _FATAL
        # Which limits a worker to its share of the cores.
        options.intra_op_num_threads = cv2.getNumThreads()
        providers = ["CPUExecutionProvider"]
        try:
            # A fallback would try the same again, and print.
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=providers, enable_fallback=0
            )
            self.inputs: dict[str, tuple[int | None, ...]] = {
                value.name: tuple(
                    size if isinstance(size, int) and size > 0 else None for size in value.shape
                )
                for value in self._session.get_inputs()
            }
            self.outputs = tuple(value.name for value in self._session.get_outputs())
        except Exception as error:  # its errors have no class in common
            raise ValueError(
                f"{path}: {self._runtime} cannot load this network ({_reason(error)}); export it "
                "again."
            ) from error
        counts = [math.prod(size or 1 for size in shape) for shape in self.inputs.values()]
        require(
            max(counts, default=0) <= _MAX_VALUES,
            path,
            f"expected inputs of at most {_MAX_VALUES} values",
            written_shapes(self.inputs.values()),
            "export it for smaller images",
        )

    def run(self, inputs: Arrays) -> Arrays:
        """Return all outputs by name, in their order.

        Args:
            inputs: arrays by name.

        Raises:
            ValueError: `onnxruntime` cannot run the network on them, or it returns other values
                than finite numbers.
        """
        try:
            results = self._session.run(None, dict(inputs))
        except Exception as error:  # its errors have no class in common
            shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in inputs.items())
            raise ValueError(
                f"{self.path}: {self._runtime} cannot run this network on {shapes} "
                f"({_reason(error)}); export it for these sizes."
            ) from error
        arrays: dict[str, Any] = dict(zip(self.outputs, results, strict=True))
        for name, value in arrays.items():
            place = f"{self.path}, output {name}"
            require(
                isinstance(value, np.ndarray) and value.dtype.kind in "biuf",
                place,
                "expected numbers",
                kind_of(value),
                "export again",
            )
            require(
                np.isfinite(value).all(),
                place,
                "expected finite numbers",
                "NaN or infinity",
                "check the value range, or export it in float32",
            )
        return arrays


def imagenet_blob(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return an image as a network's input [1, 3, height, width] float32, normalised by ImageNet's
    colours.

    Args:
        image: [H, W, 3], RGB, uint8 or float in [0, 1]; it is stretched to the size.
        width: of the input.
        height: of the input.
    """
    method = cv2.INTER_AREA if image.shape[1] > width else cv2.INTER_LINEAR
    unit = cv2.resize(unit_values(image, np.float32), (width, height), interpolation=method)
    return np.ascontiguousarray(np.moveaxis((unit - _MEAN) / _DEVIATION, 2, 0)[None])


def written_shapes(shapes: Iterable[tuple[int | None, ...]]) -> str:
    """Return shapes as in an error message, with ? for a size that is left open."""
    texts = (
        "[" + ", ".join("?" if size is None else str(size) for size in shape) + "]"
        for shape in shapes
    )
    return " and ".join(texts) or "none"


def _reason(error: Exception) -> str:
    """Return the message of an error of `onnxruntime` in one line, without its number."""
    return " ".join(str(error).split(" : ")[-1].split())

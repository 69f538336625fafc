"""Networks of a few operators with known flow, exported as ONNX files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

# Weights of red, green and blue per flow component. They all differ: any swap shows.
OF_IMAGE = np.array([[0.1, 0.2, 0.3], [0.02, 0.05, 0.01]], np.float32)
OF_OTHER = np.array([[-0.3, 0.1, 0.2], [0.04, 0.03, -0.02]], np.float32)


def known_flow(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the network's flow [H, W, 2] for two images [H, W, 3] in its own range of values."""
    return image @ OF_IMAGE.T + other @ OF_OTHER.T


def export(
    path: Path, height: int | str = "h", width: int | str = "w", inputs: int = 2, channels: int = 2
) -> Path:
    """Write a network with RAFT's signature: it takes two images and returns flow at an eighth and
    at the full size.

    It requires multiples of 8, as RAFT does: the full flow includes the small one enlarged, times
    0.
    """
    names = [f"image{k}" for k in range(1, inputs + 1)]
    weights = dict(zip(names, (OF_IMAGE, OF_OTHER, OF_OTHER), strict=False))
    constants = {f"{name}.weight": w[:channels, :, None, None] for name, w in weights.items()}
    constants |= {
        "ones": np.ones((channels, 1, 8, 8), np.float32),
        "nothing": np.zeros(1, np.float32),
    }
    nodes = [helper.make_node("Conv", [name, f"{name}.weight"], [f"{name}.part"]) for name in names]
    nodes += [
        helper.make_node("Sum", [f"{name}.part" for name in names], ["sum"]),
        helper.make_node("AveragePool", ["sum"], ["flow_low"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node(
            "ConvTranspose", ["flow_low", "ones"], ["large"], strides=[8, 8], group=channels
        ),
        helper.make_node("Mul", ["large", "nothing"], ["no_flow"]),
        helper.make_node("Add", ["sum", "no_flow"], ["flow_up"]),
    ]
    sizes = (1, 3, height, width), (1, channels, None, None)
    return write(
        path,
        nodes,
        dict.fromkeys(names, sizes[0]),
        dict.fromkeys(("flow_low", "flow_up"), sizes[1]),
        constants,
    )


def export_lookup(path: Path, height: int, width: int) -> Path:
    """Write a network that looks up the second image in the first one's grid turned by 180 degrees,
    as RAFT looks up correlations: the flow is the difference of red and of green, at half weight.
    """
    y = np.linspace(1, -1, height)
    x = np.linspace(1, -1, width)
    weights = np.array([[0.5, 0, 0], [0, 0.5, 0]], np.float32)[:, :, None, None]
    grid = np.stack(np.meshgrid(x, y), axis=-1)[None].astype(np.float32)
    nodes = [
        helper.make_node("GridSample", ["image2", "grid"], ["turned"], align_corners=1),
        helper.make_node("Sub", ["turned", "image1"], ["difference"]),
        helper.make_node("Conv", ["difference", "weights"], ["flow"]),
    ]
    inputs = dict.fromkeys(("image1", "image2"), (1, 3, height, width))
    return write(
        path, nodes, inputs, {"flow": [1, 2, height, width]}, {"weights": weights, "grid": grid}
    )


def write(
    path: Path, nodes: list, inputs: dict, outputs: dict, constants: dict[str, np.ndarray]
) -> Path:
    """Write nodes as a network; inputs and outputs are float32, their shapes by name."""
    ends = (
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
            for name, shape in values.items()
        ]
        for values in (inputs, outputs)
    )
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "tiny", *ends, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 16)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path

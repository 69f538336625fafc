"""A network without weights, with the inputs and outputs of LPIPS."""

from __future__ import annotations

from pathlib import Path

from onnx import helper

from tests.scenes.tiny_network import write


def squared_difference(
    path: Path, height: int, width: int, spatial: bool = True, inputs=("in0", "in1")
) -> Path:
    """Write the network mean((in0 - in1)^2) over the channels, or over all; inputs
    [1, 3, height, width].
    """
    nodes = [
        helper.make_node("Sub", inputs, ["difference"]),
        helper.make_node("Mul", ["difference", "difference"], ["square"]),
        helper.make_node(
            "ReduceMean", ["square"], ["out"], axes=[1] if spatial else [1, 2, 3], keepdims=1
        ),
    ]
    size = (1, 1, height, width) if spatial else (1, 1, 1, 1)
    return write(path, nodes, dict.fromkeys(inputs, (1, 3, height, width)), {"out": size}, {})

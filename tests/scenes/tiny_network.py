"""Networks of a few operators with known flow, exported as ONNX files."""

import numpy as np
import onnx
import onnx.parser
from onnx import helper, numpy_helper

# Weights of red, green and blue per flow component. They all differ: any swap shows.
OF_IMAGE = np.array([[0.1, 0.2, 0.3], [0.02, 0.05, 0.01]], np.float32)
OF_OTHER = np.array([[-0.3, 0.1, 0.2], [0.04, 0.03, -0.02]], np.float32)


def known_flow(image, other):
    """Return the network's flow [H, W, 2] for two images [H, W, 3] in its own range of values."""
    return image @ OF_IMAGE.T + other @ OF_OTHER.T


def export(path, height="h", width="w", inputs=2, channels=2):
    """Write a network with RAFT's signature: it takes two images and returns flow at an eighth and
    at the full size.

    It requires multiples of 8, as RAFT does: the full flow includes the small one enlarged, times
    0.
    """
    names = [f"image{k}" for k in range(1, inputs + 1)]
    weights = dict(zip(names, (OF_IMAGE, OF_OTHER, OF_OTHER), strict=False))
    size = f"float[1, 3, {height}, {width}]"
    flow = f"float[1, {channels}, ?, ?]"
    convolutions = "\n".join(f"{name}_part = Conv({name}, {name}_weight)" for name in names)
    graph = f"""raft ({", ".join(f"{size} {name}" for name in names)})
        => ({flow} flow_low, {flow} flow_up) {{
      {convolutions}
      sum = Sum({", ".join(f"{name}_part" for name in names)})
      flow_low = AveragePool <kernel_shape = [8, 8], strides = [8, 8]> (sum)
      large = ConvTranspose <strides = [8, 8], group = {channels}> (flow_low, ones)
      no_flow = Mul(large, nothing)
      flow_up = Add(sum, no_flow)
    }}"""
    return write(
        path,
        graph,
        **{f"{name}_weight": w[:channels, :, None, None] for name, w in weights.items()},
        ones=np.ones((channels, 1, 8, 8), np.float32),
        nothing=np.zeros(1, np.float32),
    )


def squared_difference(
    path,
    height,
    width,
    spatial=True,
    inputs=("in0", "in1"),
):
    """Write the network mean((in0 - in1)^2) over the channels, or over all, with the signature of
    LPIPS; inputs [1, 3, height, width].
    """
    size = f"float[1, 3, {height}, {width}]"
    axes, shape = ([1], [1, 1, height, width]) if spatial else ([1, 2, 3], [1, 1, 1, 1])
    graph = f"""lpips ({size} {inputs[0]}, {size} {inputs[1]}) => (float{shape} out) {{
      difference = Sub({", ".join(inputs)})
      square = Mul(difference, difference)
      out = ReduceMean <axes = {axes}, keepdims = 1> (square)
    }}"""
    return write(path, graph)


def write(path, graph, **constants):
    """Write the network of a graph in ONNX's text format, with constants by their names."""
    parsed = onnx.parser.parse_graph(graph)
    parsed.initializer.extend(numpy_helper.from_array(v, name) for name, v in constants.items())
    model = helper.make_model(parsed, opset_imports=[helper.make_opsetid("", 16)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path

"""ONNX files of three nodes, written without the package `onnx`, as networks without weights for tests.

Field numbers are those of onnx.proto; a message is a sequence of (number << 3 | wire type, value).
"""

from __future__ import annotations

from pathlib import Path

_FLOAT, _INT_ATTRIBUTE, _INTS_ATTRIBUTE = 1, 2, 7


def squared_difference(path: Path, height: int, width: int, spatial: bool = True, inputs=("in0", "in1")) -> Path:
    """Write the network mean((in0 - in1)^2) over the channels, or over all; inputs [1, 3, height, width]."""
    first, second = inputs
    axes = [1] if spatial else [1, 2, 3]
    over = _field(1, "axes") + b"".join(_field(8, axis) for axis in axes) + _field(20, _INTS_ATTRIBUTE)
    kept = _field(1, "keepdims") + _field(3, 1) + _field(20, _INT_ATTRIBUTE)
    nodes = (
        _node("Sub", (first, second), "difference"),
        _node("Mul", ("difference", "difference"), "square"),
        _node("ReduceMean", ("square",), "out", over, kept),
    )
    size = (1, 1, height, width) if spatial else (1, 1, 1, 1)
    graph = b"".join(_field(1, node) for node in nodes) + _field(2, "squared_difference")
    graph += b"".join(_field(11, _tensor(name, (1, 3, height, width))) for name in inputs)
    graph += _field(12, _tensor("out", size))
    opset = _field(1, "") + _field(2, 13)
    path.write_bytes(_field(1, 8) + _field(8, opset) + _field(7, graph))
    return path


def _node(kind: str, inputs: tuple[str, ...], output: str, *attributes: bytes) -> bytes:
    named = b"".join(_field(1, name) for name in inputs) + _field(2, output) + _field(4, kind)
    return named + b"".join(_field(5, attribute) for attribute in attributes)


def _tensor(name: str, shape: tuple[int, ...]) -> bytes:
    dimensions = b"".join(_field(1, _field(1, size)) for size in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, _FLOAT) + _field(2, dimensions)))


def _field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _varint(value: int) -> bytes:
    head = b""
    while value > 127:
        head += bytes([value & 127 | 128])
        value >>= 7
    return head + bytes([value])

"""LPIPS: inputs and outputs of a network, and errors for unsuitable ones."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.evaluate.lpips import Lpips
from tests.assertions import assert_close
from tests.evaluate.tiny_onnx import squared_difference

H, W = 12, 17
IMAGE, TRUTH = np.random.default_rng(0).random((2, H, W, 3))
# The network receives images from -1 to 1, in float32.
EXPECTED = (4 * (IMAGE - TRUTH) ** 2).mean(-1)


def test_lpips__spatial_network_gives_a_map(tmp_path):
    distance = Lpips(squared_difference(tmp_path / "net.onnx", H, W)).distance_map(IMAGE, TRUTH)
    assert_close(distance, EXPECTED, atol=1e-6)


def test_lpips__other_network_gives_one_number(tmp_path):
    net = Lpips(squared_difference(tmp_path / "net.onnx", H, W, spatial=False))
    assert_close(net.distance_map(IMAGE, TRUTH), [[EXPECTED.mean()]], atol=1e-6)
    assert net.distance_map(IMAGE, IMAGE) == 0


def test_lpips__bytes_and_floats_agree(tmp_path):
    net = Lpips(squared_difference(tmp_path / "net.onnx", H, W))
    a, b = ((x * 255).astype(np.uint8) for x in (IMAGE, TRUTH))
    np.testing.assert_allclose(net.distance_map(a, b), net.distance_map(a / 255, b / 255))


def test_lpips__refuses_unsuitable_networks(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected an LPIPS network as ONNX, found none"):
        Lpips(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"rubbish")
    with pytest.raises(ValueError, match=r"bad\.onnx: expected an ONNX network"):
        Lpips(tmp_path / "bad.onnx")
    other = Lpips(squared_difference(tmp_path / "other.onnx", H, W, inputs=("left", "right")))
    with pytest.raises(ValueError, match="inputs in0 and in1 that take 17x12 pixels"):
        other.distance_map(IMAGE, TRUTH)
    net = Lpips(squared_difference(tmp_path / "net.onnx", H, W))
    with pytest.raises(ValueError, match="one size"):
        net.distance_map(IMAGE, TRUTH[1:])

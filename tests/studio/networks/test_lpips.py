"""LPIPS: inputs and outputs of a network, and errors for unsuitable ones."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.studio.networks.lpips import Lpips
from tests.assertions import assert_close
from tests.scenes.tiny_network import squared_difference

H = 12
W = 17
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
    with pytest.raises(FileNotFoundError, match="expected an ONNX file, found none"):
        Lpips(tmp_path / "none.onnx")
    with pytest.raises(
        ValueError, match="inputs in0 and in1, got left, right; export the network as"
    ):
        Lpips(squared_difference(tmp_path / "other.onnx", H, W, inputs=("left", "right")))
    net = Lpips(squared_difference(tmp_path / "net.onnx", H, W))
    with pytest.raises(
        ValueError,
        match=r"cannot run this network on in0 \[1, 3, 12, 16\], .*; export it for these",
    ):
        net.distance_map(IMAGE[:, 1:], TRUTH[:, 1:])
    with pytest.raises(
        ValueError, match=r"net\.onnx, output .*: expected finite numbers, got NaN or infinity"
    ):
        net.distance_map(np.full_like(IMAGE, 1e30), TRUTH)
    with pytest.raises(ValueError, match="one size"):
        net.distance_map(IMAGE, TRUTH[1:])

"""LPIPS: inputs and outputs of a network, and errors for unsuitable ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.evaluate.lpips import Lpips
from morgs_mi.testing import assert_close
from tests.scenes.tiny_network import squared_difference

H = 12
W = 17
IMAGE, TRUTH = np.random.default_rng(0).random((2, H, W, 3))
# The network receives images from -1 to 1, in float32.
EXPECTED = (4 * (IMAGE - TRUTH) ** 2).mean(-1)


def test_lpips__spatial_network_gives_a_map(tmp_path):
    net = Lpips(squared_difference(tmp_path / "net.onnx", H, W))
    assert_close(net.distance_map(IMAGE, TRUTH), EXPECTED, atol=1e-6)
    image, truth = ((255 * values).astype(np.uint8) for values in (IMAGE, TRUTH))
    expected = net.distance_map(image / 255, truth / 255)
    assert_allclose(net.distance_map(image, truth), expected)


def test_lpips__refuses_unsuitable_networks(tmp_path):
    with pytest.raises(
        ValueError, match="inputs in0 and in1, got left, right; export the network as"
    ):
        Lpips(squared_difference(tmp_path / "other.onnx", H, W, inputs=("left", "right")))
    single = Lpips(squared_difference(tmp_path / "net.onnx", H, W, spatial=False))
    with pytest.raises(
        ValueError,
        match=r"expected a distance for each of 17x12 pixels, got \[1, 1, 1, 1\]; export the",
    ):
        single.distance_map(IMAGE, TRUTH)


@pytest.mark.parametrize(
    ("image", "truth", "message"),
    [
        (
            IMAGE[:, 1:],
            TRUTH[:, 1:],
            r"cannot run this network on in0 \[1, 3, 12, 16\], .*; export it for these",
        ),
        (
            np.full_like(IMAGE, 1e30),
            TRUTH,
            r"net\.onnx, output .*: expected finite numbers, got NaN or infinity",
        ),
        (IMAGE, TRUTH[1:], "one size"),
    ],
)
def test_lpips__refuses_unsuitable_images(tmp_path, image, truth, message):
    net = Lpips(squared_difference(tmp_path / "net.onnx", H, W))
    with pytest.raises(ValueError, match=message):
        net.distance_map(image, truth)

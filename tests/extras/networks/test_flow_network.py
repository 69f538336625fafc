"""Flow networks: order, channels, range, padding and scale of inputs and outputs."""

import numpy as np
import pytest

from morgs_mi.extras.networks.flow_network import FlowNetwork
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES, FramePair
from morgs_mi.testing import assert_close
from tests.scenes.tiny_network import export, known_flow

# Float32 sums of six products of up to 255 each.
TOLERANCE = 1e-3


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    return export(tmp_path_factory.mktemp("network") / "tiny.onnx")


def image_pair(height, width):
    return np.random.default_rng(height).integers(0, 255, (2, height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("size", [(32, 48), (40, 24), (17, 31), (90, 50), (33, 33)])
def test_flow_network__returns_the_known_flow_at_any_size(network, size):
    image, other = image_pair(*size)
    flow = FlowNetwork(network)(image, other)
    assert flow.shape == (*size, 2)
    assert flow.dtype == np.float32
    assert_close(flow, known_flow(image, other), atol=TOLERANCE)


@pytest.mark.parametrize(
    ("kind", "low", "high"), [("onnx", 0, 255), ("onnx-unit", 0, 1), ("onnx-signed", -1, 1)]
)
def test_flow_source__runs_a_network_both_ways_in_its_value_range(network, kind, low, high):
    pair = image_pair(24, 40)
    source = FLOW_SOURCES.make(f"{kind}:{network}")
    a, b = low + (high - low) / 255 * pair.astype(float)
    for images in (pair, pair / 255):
        back, forward_flow = source(FramePair(*images))
        assert_close(back, known_flow(a, b), atol=TOLERANCE)
        assert_close(forward_flow, known_flow(b, a), atol=TOLERANCE)


def test_flow_network__of_fixed_size_resizes_images_and_flow(tmp_path):
    # Away from the border, resizing does not change colours that vary linearly.
    y, x = np.mgrid[:60, :100] / 100
    image = np.stack([x, y, x + y], -1) / 2
    other = np.stack([y, x, x], -1) / 2
    flow = FlowNetwork(export(tmp_path / "fixed.onnx", 32, 40), 0, 1)(image, other)
    expected = known_flow(image, other) * (100 / 40, 60 / 32)
    away = np.zeros((60, 100, 1), bool)
    away[5:-5, 5:-5] = True
    assert_close(flow, expected, atol=0.01, where=away)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inputs": 1}, r"two images \[1, 3, H, W\] as inputs, .*, got \[1, 3, \?, \?\];"),
        ({"inputs": 3}, r"two images .* and \[1, 3, \?, \?\] and"),
        ({"height": 64}, r"both fixed or both open, got \[1, 3, 64, \?\] and"),
    ],
)
def test_flow_source__rejects_a_file_that_is_not_a_flow_network(tmp_path, options, message):
    path = export(tmp_path / "a.onnx", **options)
    with pytest.raises(ValueError, match=message):
        FLOW_SOURCES.make(f"onnx:{path}")


def test_flow_network__rejects_an_output_that_is_not_flow(tmp_path):
    path = export(tmp_path / "scalar.onnx", channels=1)
    with pytest.raises(
        ValueError,
        match=r"output \[1, 2, 16, 24\], the flow, got \[1, 1, 2, 3\] and \[1, 1, 16, 24\]",
    ):
        FlowNetwork(path)(*image_pair(16, 24))


def test_flow_network__names_the_file_where_it_fails(network, monkeypatch):
    monkeypatch.setattr("morgs_mi.extras.networks.flow_network.MULTIPLE", 1)
    with pytest.raises(
        ValueError,
        match=r"tiny\.onnx: onnxruntime .* on image1 \[1, 3, 20, 30\], image2 .*; export it for",
    ):
        FlowNetwork(network)(*image_pair(20, 30))

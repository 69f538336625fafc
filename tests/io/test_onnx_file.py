"""Networks in ONNX files: signature and input."""

from __future__ import annotations

import numpy as np

from morgs_mi.io.onnx_file import imagenet_blob, read_signature
from tests.assertions import assert_close
from tests.scenes.tiny_network import export


def test_read_signature__returns_names_and_shapes(tmp_path):
    open_size = read_signature(export(tmp_path / "open.onnx"))
    assert open_size.inputs == {"image1": (1, 3, None, None), "image2": (1, 3, None, None)}
    assert open_size.outputs == ("flow_low", "flow_up")
    assert read_signature(export(tmp_path / "fixed.onnx", 64, 96)).inputs["image2"] == (1, 3, 64, 96)


def test_imagenet_blob__is_normalised_and_channels_come_first():
    image = np.full((20, 30, 3), (255, 0, 51), np.uint8)
    blob = imagenet_blob(image, 28, 14)
    assert blob.shape == (1, 3, 14, 28)
    expected = (np.array([1, 0, 0.2]) - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    assert_close(blob[0, :, 3, 4], expected, atol=1e-5)
    assert_close(imagenet_blob(image / 255, 28, 14), blob, atol=1e-5)

"""Networks in ONNX files: inputs and outputs, hostile files, and the image as an input."""

import os
import re
import sys

import cv2
import numpy as np
import onnx
import pytest
from onnx.external_data_helper import set_external_data

from morgs_mi.io.onnx_file import OnnxNetwork
from tests.scenes.tiny_network import export, write

VALUES = 1024


def test_onnx_network__has_names_and_shapes(tmp_path):
    network = OnnxNetwork(export(tmp_path / "open.onnx", width=96))
    assert network.inputs == dict.fromkeys(("image1", "image2"), (1, 3, None, 96))
    assert network.outputs == ("flow_low", "flow_up")


def test_onnx_network__has_at_most_the_threads_of_opencv(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 1)
    assert (
        OnnxNetwork(export(tmp_path / "a.onnx"))._session.get_session_options().intra_op_num_threads
        == 1
    )


def test_onnx_network__names_the_extra_that_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(
        ValueError, match=r"a\.onnx: .* needs the package onnxruntime; pip .*'morgs-mi\[networks\]'"
    ):
        OnnxNetwork(export(tmp_path / "a.onnx"))


def with_weights_at(path, location):
    """Write a network that adds weights in a further file at `location`."""
    graph = f"sum (float[{VALUES}] x) => (float[{VALUES}] y) {{ y = Add(x, w) }}"
    model = onnx.load(write(path, graph, w=np.zeros(VALUES, np.float32)))
    (weights,) = model.graph.initializer
    set_external_data(weights, location, offset=0, length=4 * VALUES)
    weights.ClearField("raw_data")
    path.write_bytes(model.SerializeToString())
    return path


def test_onnx_network__reads_weights_in_its_folder(tmp_path):
    np.full(VALUES, 3, np.float32).tofile(tmp_path / "weights.bin")
    network = OnnxNetwork(with_weights_at(tmp_path / "a.onnx", "weights.bin"))
    assert network.run({"x": np.ones(VALUES, np.float32)})["y"][0] == 4


@pytest.mark.parametrize(
    "location", ["../secret.bin", "{}/secret.bin", "link.bin", "a/../../secret.bin"]
)
def test_onnx_network__reads_no_weights_outside_its_folder(tmp_path, location):
    np.zeros(VALUES, np.float32).tofile(tmp_path / "secret.bin")
    folder = tmp_path / "network"
    (folder / "a").mkdir(parents=True)
    (folder / "link.bin").symlink_to("../secret.bin")
    path = with_weights_at(folder / "a.onnx", location.format(tmp_path))
    with pytest.raises(
        ValueError, match=r"a\.onnx: onnxruntime .* cannot load this network .*; export it again\."
    ):
        OnnxNetwork(path)


def endless_number(path):
    path.write_bytes(b"\x08" + b"\xff" * 2_000_000 + b"\x01")


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (
            endless_number,
            ValueError,
            r"onnxruntime .* cannot load this network \(.*\); export it again",
        ),
        (os.mkfifo, FileNotFoundError, "expected an ONNX file, found none"),
        (lambda path: export(path, 2**40, 8), ValueError, r"got \[1, 3, 1099511627776, 8\]"),
    ],
)
def test_onnx_network__refuses_a_hostile_file(tmp_path, make, kind, message):
    path = tmp_path / "a.onnx"
    make(path)
    with pytest.raises(kind, match=rf"a\.onnx: .*{message}"):
        OnnxNetwork(path)


def test_onnx_network__refuses_damaged_files_with_one_sentence(tmp_path, capfd):
    path = tmp_path / "a.onnx"
    rng = np.random.default_rng(0)
    whole = export(path).read_bytes()
    messages = []
    inputs = dict.fromkeys(("image1", "image2"), np.zeros((1, 3, 16, 24), np.float32))
    for _ in range(200):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            OnnxNetwork(path).run(inputs)
        except ValueError as error:
            messages.append(str(error))
    assert len(messages) > 50
    assert all(re.fullmatch(rf"{path}: [^\n]+", message) for message in messages)
    assert capfd.readouterr() == ("", "")


def test_onnx_network__refuses_results_that_are_not_numbers(tmp_path):
    graph = "text (float[1, 2] image) => (string[1, 2] text) { text = Cast <to = 8> (image) }"
    with pytest.raises(
        ValueError, match=r"a\.onnx, output text: expected numbers, got object \[1, 2\]"
    ):
        OnnxNetwork(write(tmp_path / "a.onnx", graph)).run({"image": np.zeros((1, 2), np.float32)})

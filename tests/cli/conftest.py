"""The command line in this process, and a capture and a stream to run it on."""

import json

import pytest

from morgs_mi.cli.main import main
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from tests.scenes import noise_capture
from tests.scenes.gaussians import isotropic


@pytest.fixture
def run(capsys):
    """`morgs-mi` with arguments; returns its status, standard output and standard error."""

    def call(*args):
        status = main([str(a) for a in args])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call


@pytest.fixture
def capture(tmp_path):
    """Three cameras with moving noise."""
    return noise_capture.write_capture(tmp_path / "capture")


@pytest.fixture
def stream(tmp_path):
    """A stream of one splat in two frames."""
    path = tmp_path / "good.morgs"
    splat = isotropic([[0, 0, 0]], 0.3, 0.9, (1.0, 0, 0))
    with StreamWriter(path, noise_capture.rig(), 25) as writer:
        writer.write(keyframe_packet(splat, 0))
        writer.write(keyframe_packet(splat, 1))
    return path


@pytest.fixture
def far_cameras():
    """The report of a fit of cameras that are far apart."""
    row = {"frame": 0, "seconds": 1, "validation": {"quality": "poor", "spacing": 58.4}}
    return json.dumps({"frames": [row]})

"""A tiny capture and one path tracer, shared by the tests of this subpackage."""

import pytest

from morgs_mi.extras.synth.path_tracer import PathTracer
from morgs_mi.extras.synth.scene import load_scene
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import synthesize


@pytest.fixture(scope="session")
def tracer():
    """The scene `spheres`, at the time that the previous test has set."""
    return PathTracer(load_scene("spheres"))


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """The scene `arm` from 3 cameras, 3 frames of 64x48, with lossless frames."""
    out = tmp_path_factory.mktemp("synth") / "arm"
    return synthesize(
        "arm", out, SynthConfig(cameras=3, frames=3, width=64, height=48, spp=4, lossless=True)
    )

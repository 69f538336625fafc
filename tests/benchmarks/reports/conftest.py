"""A small clip with ground truth."""

from __future__ import annotations

import pytest

from morgs_mi.studio.synth.synth_config import SynthConfig
from morgs_mi.studio.synth.synthesize import synthesize


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """The balls from 5 cameras in 3 tiny frames."""
    folder = tmp_path_factory.mktemp("clip") / "spheres"
    return synthesize(
        "spheres", folder, SynthConfig(cameras=5, frames=3, width=48, height=36, spp=1)
    )

"""A scene of ten Gaussians that overlap, and its camera."""

import pytest

from tests.reference import rasterize_view
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import as_float32, make_scene


@pytest.fixture(scope="session")
def scene():
    raw = as_float32(make_scene())
    camera = make_camera()
    assert rasterize_view(raw, camera)["margin"] > 1e-5, "the scene must stay clear of the cut-offs"
    return raw, camera

"""A scene of ten Gaussians that overlap, and its camera."""

from __future__ import annotations

import pytest

from morgs_mi import Camera
from tests.reference import rasterize_view
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import Values, as_float32, make_scene


@pytest.fixture(scope="session")
def scene() -> tuple[Values, Camera]:
    raw = as_float32(make_scene())
    camera = make_camera()
    assert rasterize_view(raw, camera)["margin"] > 1e-5, "the scene must stay clear of the cut-offs"
    return raw, camera

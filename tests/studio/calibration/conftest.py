"""The capture of textured planes, by short names, and clips of moving ones."""

from __future__ import annotations

import pytest

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.points import SharedFeatures
from tests.scenes.filmed import Clips, film


@pytest.fixture(scope="session")
def capture(textured_capture: Capture) -> Capture:
    return textured_capture


@pytest.fixture(scope="session")
def shared(textured_features: SharedFeatures) -> SharedFeatures:
    return textured_features


@pytest.fixture(scope="session")
def clips() -> Clips:
    return film()

"""The capture of textured planes, by short names."""

from __future__ import annotations

import pytest

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.points import SharedFeatures


@pytest.fixture(scope="session")
def capture(textured_capture: Capture) -> Capture:
    return textured_capture


@pytest.fixture(scope="session")
def shared(textured_features: SharedFeatures) -> SharedFeatures:
    return textured_features

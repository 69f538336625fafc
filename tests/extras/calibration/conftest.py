"""The capture of textured planes, by short names."""

import pytest


@pytest.fixture(scope="session")
def capture(textured_capture):
    return textured_capture


@pytest.fixture(scope="session")
def shared(textured_features):
    return textured_features

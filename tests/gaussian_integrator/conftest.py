"""Raw attributes of a cloud that Mitsuba's shapes can hold."""

import pytest

from tests.scenes.gaussians import make_unit_scene


@pytest.fixture(scope="session")
def raw():
    return make_unit_scene()

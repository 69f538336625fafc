"""Raw attributes of a cloud that Mitsuba's shapes can hold."""

from __future__ import annotations

import pytest

from tests.scenes.gaussians import Values, make_unit_scene


@pytest.fixture(scope="session")
def raw() -> Values:
    return make_unit_scene()

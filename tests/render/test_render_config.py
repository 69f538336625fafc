"""Settings of the renderer."""

import pytest

from morgs_mi import RenderConfig


def test_render_config__refuses_a_least_alpha_that_is_not_below_the_largest():
    with pytest.raises(
        ValueError,
        match=r"RenderConfig\(\): `alpha_min` must be below `alpha_max` = 0\.4, got 0\.5",
    ):
        RenderConfig(alpha_min=0.5, alpha_max=0.4)

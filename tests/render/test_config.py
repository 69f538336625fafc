"""Settings of the renderer."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi import RenderConfig


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"block_width": 17}, "must be 4, 8, 12 or 16 px, got 17"),
        ({"block_width": 8.0}, "must be 4, 8, 12 or 16 px, got 8.0"),
        ({"block_height": 2.5}, "must be an integer from 1 to 16 px, got 2.5"),
        ({"block_height": 0}, "must be an integer from 1 to 16 px, got 0"),
        ({"eps2d": np.nan}, r"`eps2d` must be a number in \[0, 1e18\], got nan"),
        ({"eps2d": -1}, "`eps2d` must be a number"),
        ({"eps2d": "0.3"}, "`eps2d` must be a number"),
        ({"alpha_min": 0}, r"`alpha_min` must be a number in \(0, 0.99\)"),
        ({"alpha_min": 0.5, "alpha_max": 0.4}, r"`alpha_min` must be a number in \(0, 0.4\)"),
        ({"alpha_max": 1}, r"`alpha_max` must be a number in \(0, 1\)"),
        ({"stop_transmittance": np.inf}, r"`stop_transmittance` must be a number in \[0, 1\)"),
    ],
)
def test_render_config__refuses_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        RenderConfig(**settings)

"""The renderer with thousands of layers on a pixel, and millions of Gaussians."""

import numpy as np
import pytest

from morgs_mi import Camera, rasterize
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.render.exact import (
    BACKGROUND,
    CONFIG,
    Activated,
    exact_image,
    run,
)
from tests.scenes.extremes import million_on_a_pixel, stack
from tests.scenes.gaussians import CHANNELS


@pytest.mark.slow
def test_rasterize__blends_a_million_gaussians_on_one_pixel():
    errors = million_on_a_pixel()
    assert errors["image"] < tol.IMAGE_ABS
    # Behind thousands of layers, gradients are rounding errors of the sum of all.
    assert max(errors.values()) < tol.FUZZ_GRADIENT_REL, errors


def test_rasterize__blends_many_equal_depths_in_the_order_of_the_input():
    """Of 300 layers at one depth, the first in the input is the nearest; in reversed order, the
    last is.
    """
    values = stack(300, 0.3)
    values["means"][:, 2] = 1.5
    camera = Camera(np.array([[9.0, 0, 3], [0, 9, 2.5], [0, 0, 1]]), np.eye(4), 6, 5)
    images = []
    for order in (slice(None), slice(None, None, -1)):
        ordered = {name: np.ascontiguousarray(value[order]) for name, value in values.items()}
        images.append(run(ordered, camera)[0]["color"])
        assert_close(
            images[-1], np.float64(exact_image(ordered, camera)["color"]), atol=tol.IMAGE_ABS
        )
    assert np.abs(images[0] - images[1]).max() > 0.05


def test_rasterize__refuses_lists_that_exceed_32_bits():
    """2^12 x 2^12 pixels are 2^14 tiles, and entries are counted in 32 bits."""
    camera = Camera(np.array([[1e4, 0, 2048], [0, 1e4, 2048], [0, 0, 1]]), np.eye(4), 2**12, 2**12)
    values = stack(2**18 + 1, 0.5) | {"scales": np.full((2**18 + 1, 3), 1e3)}
    # Blocks on a GPU are half as large as on a CPU, and there are twice as many entries.
    with pytest.raises(
        ValueError, match=r"fewer than 2\^32 entries, got (4\.29|8\.59)e\+09 for 262145 Gaussians"
    ):
        rasterize(Activated(values), camera, CHANNELS, BACKGROUND, config=CONFIG)

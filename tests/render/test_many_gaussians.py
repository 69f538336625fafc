"""The renderer with thousands of layers on a pixel, and millions of Gaussians."""

import numpy as np
import pytest

from morgs_mi import Camera, RenderConfig, rasterize
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.render.exact import (
    ATTRIBUTES,
    BACKGROUND,
    CONFIG,
    Activated,
    exact_image,
    run,
)
from tests.scenes.extremes import ONE_PIXEL, cloud, eye, million_on_a_pixel, stack
from tests.scenes.gaussians import CHANNELS


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [1.0, 0.99, 0.02])
def test_rasterize__blends_ten_thousand_layers_on_one_pixel(opacity):
    values = stack(10_000, opacity)
    camera = ONE_PIXEL
    expected = exact_image(values, camera)
    for config in (CONFIG, RenderConfig()):
        image, grads = run(values, camera, config=config)
        hidden = config.stop_transmittance if config is not CONFIG else 0
        for name in CHANNELS:
            bound = (tol.IMAGE_ABS + 2 * hidden) * max(1, np.abs(expected[name]).max())
            assert_close(image[name], np.float64(expected[name]), atol=bound, name=name)
        if opacity > 0.9:
            assert np.abs(grads["sh_coeffs"][8:]).max() < 1e-12, (
                "occluded Gaussians have no gradient"
            )


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


@pytest.mark.long
def test_rasterize__two_million_gaussians_mostly_out_of_view():
    """All but 1,000 are out of view: the image shows the 1,000, and their gradients are complete
    and finite.
    """
    N = 2_000_000
    in_view = 1_000
    rng = np.random.default_rng(0)
    values = {name: np.repeat(value, N // 1000, axis=0) for name, value in cloud(1000).items()}
    values["means"] += rng.normal(size=(N, 3)) * 0.3
    values["scales"] *= 0.05
    where = np.sort(rng.choice(N, in_view, replace=False))
    away = np.ones(N, bool)
    away[where] = False
    values["means"][away] = values["means"][away] * 100 - (0, 0, 1e4)
    camera = eye(640, 480)
    image, grads = run(values, camera)
    few, few_grads = run({name: value[where] for name, value in values.items()}, camera)
    for name in CHANNELS:
        assert_close(image[name], few[name], name=name)
    for name in ATTRIBUTES:
        assert_close(grads[name][where], few_grads[name], rtol=1e-5, name=name)
        assert np.abs(grads[name][away]).max() == 0, name


@pytest.mark.long
def test_rasterize__two_million_gaussians_in_view():
    values = {name: np.repeat(value, 2000, axis=0) for name, value in cloud(1000).items()}
    values["means"] += np.random.default_rng(0).normal(size=values["means"].shape) * 0.3
    values["scales"] *= 0.02
    image, grads = run(values, eye(640, 480))
    assert image["alpha"].max() > 0.999
    assert np.abs(grads["means"]).max() > 0


def test_rasterize__refuses_lists_that_exceed_32_bits():
    """2^12 x 2^12 pixels are 2^14 tiles, and entries are counted in 32 bits."""
    camera = Camera(np.array([[1e4, 0, 2048], [0, 1e4, 2048], [0, 0, 1]]), np.eye(4), 2**12, 2**12)
    values = stack(2**18 + 1, 0.5) | {"scales": np.full((2**18 + 1, 3), 1e3)}
    # Blocks on a GPU are half as large as on a CPU, and there are twice as many entries.
    with pytest.raises(
        ValueError, match=r"fewer than 2\^32 entries, got (4\.29|8\.59)e\+09 for 262145 Gaussians"
    ):
        rasterize(Activated(values), camera, CHANNELS, BACKGROUND, config=CONFIG)

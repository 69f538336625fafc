"""Regions against the full computation: the pixels and gradients that remain are the same."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import BlockGrid, Region
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.scenes.cameras import make_wide_camera
from tests.scenes.derivatives import backward, gradient, random_direction, random_weight, tangents
from tests.scenes.gaussians import CHANNELS, RAW, make_wide_scene, to_gaussians
from tests.scenes.kernels import compiled_by

BACKGROUND = (0.2, 0.5, 0.9)


@pytest.fixture(scope="module")
def camera():
    return make_wide_camera()


@pytest.fixture(scope="module")
def raw():
    return make_wide_scene(120)


@pytest.fixture(scope="module")
def mask(camera):
    """A disc, a single pixel in another tile, one at the lower edge, and the lower right corner."""
    y, x = np.mgrid[: camera.height, : camera.width]
    mask = (x - 30) ** 2 + (y - 20) ** 2 < 12**2
    mask[70, 5] = mask[74, 50] = mask[74, 100] = True
    return mask


def run(raw, camera, region=None, weight=None, config=None):
    """Return images and gradients of <image, weight>, with the weight cropped to the region."""
    gaussians = to_gaussians(raw, grad=True)
    view = ActiveView(camera, config or RenderConfig(), region)
    image = render_view(gaussians, view, CHANNELS, BACKGROUND)
    images = {name: image[name] for name in CHANNELS}
    if weight is not None:
        cropped = {name: region.crop(w) if region else w for name, w in weight.items()}
        dr.backward(
            sum(
                dr.sum(images[n] * mi.TensorXf(np.float32(cropped[n])), axis=None) for n in CHANNELS
            )
        )
    grads = {name: gradient(getattr(gaussians, name)) for name in RAW}
    return {name: np.asarray(value) for name, value in images.items()}, grads


@pytest.fixture(scope="module")
def weight(camera, mask):
    """Random weights on the pixels of the region's blocks, 0 elsewhere."""
    drawn = drawn_pixels(Region.of(mask), mask)
    return {name: random_weight(camera, name, 3) * drawn for name in CHANNELS}


def drawn_pixels(region, mask):
    """Return 1 on the pixels of the region's blocks [H, W, 1], 0 elsewhere."""
    return np.asarray(region.mask, float)[..., None]


def assert_same_gradients(result, expected, rows=slice(None)):
    for name in RAW:
        scale = np.abs(expected[name]).max()
        assert scale > 0, name
        assert_close(
            result[name][rows], expected[name][rows], atol=tol.SUM_ORDER_REL * scale, name=name
        )


def test_rasterize__on_a_region_renders_and_differentiates_like_the_full_view(
    raw, camera, mask, weight
):
    config = RenderConfig()
    region = Region.of(mask, config)
    assert region.num_blocks < 0.3 * (camera.width * camera.height) / 32
    images, grads = run(raw, camera, region, weight, config)
    full_images, full_grads = run(raw, camera, None, weight, config)
    for name in CHANNELS:
        assert np.array_equal(images[name], region.crop(full_images[name])), name
        assert (
            images[name][~region.crop(np.ones((region.height, region.width), bool))] == 0
        ).all(), name
    assert_same_gradients(grads, full_grads)


def test_rasterize__forward_mode_on_a_region_agrees_with_the_full_view(raw, camera, mask):
    region = Region.of(mask)
    results = []
    for where in (region, None):
        gaussians = to_gaussians(raw, grad=True)
        image = render_view(gaussians, ActiveView(camera, region=where), CHANNELS)
        outputs = [image[name] for name in CHANNELS]
        results.append(tangents(gaussians, random_direction(raw, 1), outputs))
    for name, tangent, expected in zip(CHANNELS, *results, strict=True):
        atol = tol.SUM_ORDER_REL * np.abs(expected).max()
        assert_close(tangent, region.crop(expected), atol=atol, name=name)


def test_rasterize__compiles_its_kernels_once_for_all_regions(raw, camera, mask):
    """Another region with another number of Gaussians compiles no kernel."""

    def step(where):
        gaussians = to_gaussians(raw, grad=True)
        image = render_view(gaussians, ActiveView(camera, region=Region.of(where)))
        backward(image.color)
        dr.eval(dr.grad(gaussians.means))
        dr.sync_thread()

    step(mask)
    assert not compiled_by(lambda: step(np.roll(mask, 21, axis=1) | (np.arange(camera.width) < 20)))


def test_region__refuses_bad_masks_and_other_views(raw, camera, mask):
    with pytest.raises(ValueError, match=r"must be of a 101x75 view with [48]x4 blocks like"):
        ActiveView(camera, region=Region.of(mask[:, :-1]))
    with pytest.raises(ValueError, match="got one of a 101x75 view with 16x4"):
        ActiveView(camera, region=Region.of(mask, RenderConfig(block_width=16)))
    broken = raw | {"means": np.where(np.arange(360).reshape(120, 3) == 7, np.nan, raw["means"])}
    with pytest.raises(ValueError, match=r"`means` must be finite, got nan at \[2, 1\]"):
        render_view(Gaussians(**broken), ActiveView(camera, region=Region.of(mask)))


@pytest.mark.parametrize("offset", range(4))
def test_rasterize__backward_reads_gradients_at_any_alignment(raw, offset):
    """A gradient may lie in NumPy's memory, at any address, although the loops read packets of
    floats.
    """
    camera = Camera.look_at((0, 0, -3.0), (0, 0, 0), (0, -1, 0), 45.0, 64, 32)
    memory = np.ones(64 * 32 * 3 + 4, np.float32)
    seed = memory[offset : offset + 64 * 32 * 3].reshape(32, 64, 3)
    gaussians = Gaussians(**raw)
    dr.enable_grad(gaussians.means)
    image = rasterize(gaussians, camera, ("color",)).color
    dr.set_grad(image, mi.TensorXf(seed))
    dr.enqueue(dr.ADMode.Backward, image)
    dr.traverse(dr.ADMode.Backward)
    assert np.isfinite(gradient(gaussians.means)).all()


@pytest.mark.parametrize("size", [(37, 45), (64, 96)])
def test_BlockGrid__counts_the_pixels_of_its_blocks(size):
    mask = np.random.default_rng(0).random(size) < 0.04
    grid = BlockGrid(size[1], size[0], (8, 4))
    rows, columns = grid.shape
    padded = np.zeros((rows * 4, columns * 8), int)
    padded[: size[0], : size[1]] = mask
    expected = padded.reshape(rows, 4, columns, 8).sum(axis=(1, 3))
    assert_array_equal(grid.counts(mask), expected)
    assert_array_equal(
        Region(grid, expected > 0).mask,
        Region.of(mask, RenderConfig(block_width=8, block_height=4)).mask,
    )

"""Boxes around projected Gaussians, against loops over them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi import RenderConfig
from morgs_mi.method.boxes import boxes_around
from morgs_mi.render.backend import block_shape
from morgs_mi.render.region import BlockGrid, Region
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.gaussians import isotropic

(CAMERA,) = look_at_cameras(arc([0.0], 4), 40, 64, 48)


@pytest.fixture(scope="module")
def boxes():
    rng = np.random.default_rng(0)
    means = rng.uniform(-2, 2, (50, 3)) * (1, 1, 0.3)
    means[7] = (0, 0, -9)  # behind the camera
    return boxes_around(
        isotropic(means, 0.1, 0.9, np.zeros((50, 1, 3))), CAMERA, RenderConfig(), 0.6
    )


def slices(boxes):
    corners = (
        np.asarray(side).astype(int) for side in (boxes.left, boxes.top, boxes.right, boxes.bottom)
    )
    return [(slice(y0, y1), slice(x0, x1)) for x0, y0, x1, y1 in zip(*corners, strict=True)]


def test_boxes__area_counts_pixels(boxes):
    assert_array_equal(boxes.area, [np.ones((48, 64))[box].sum() for box in slices(boxes)])
    assert np.asarray(boxes.area)[7] == 0


def test_union__is_the_blocks_that_the_chosen_boxes_touch(boxes):
    chosen = np.arange(50) % 3 == 0
    expected = np.zeros((48, 64), bool)
    for box in np.array(slices(boxes), object)[chosen]:
        expected[tuple(box)] = True
    grid = BlockGrid(64, 48, block_shape(RenderConfig()))
    assert_array_equal(boxes.union(chosen, grid), grid.counts(expected) > 0)


@pytest.mark.parametrize("factor", [1, 2])
def test_within__counts_pixels_in_the_blocks_of_a_reduced_view(boxes, factor):
    mask = np.random.default_rng(2).random((48 // factor, 64 // factor)) < 0.02
    region = Region.of(mask, RenderConfig())
    blocks = region.mask.repeat(factor, 0).repeat(factor, 1)
    expected = [blocks[box].sum() for box in slices(boxes)]
    assert 0 < np.mean(expected) < np.asarray(boxes.area).mean()
    assert_allclose(boxes.within(region.block_table, region.grid, factor), expected, atol=0.05)

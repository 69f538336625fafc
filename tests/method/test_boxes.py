"""Boxes around projected Gaussians, against loops over them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi import RenderConfig
from morgs_mi.method.boxes import boxes_around
from morgs_mi.render.backend import block_shape
from morgs_mi.render.region import BlockGrid, Region, stacked
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.gaussians import isotropic

SIZES = ((64, 48), (40, 56))
CAMERAS = [look_at_cameras(arc([0.2 * k], 4), 40, *size)[0] for k, size in enumerate(SIZES)]


@pytest.fixture(scope="module")
def boxes():
    rng = np.random.default_rng(0)
    means = rng.uniform(-2, 2, (50, 3)) * (1, 1, 0.3)
    means[7] = (0, 0, -9)  # behind the camera
    return boxes_around(
        isotropic(means, 0.1, 0.9, np.zeros((50, 1, 3))), CAMERAS, RenderConfig(), 0.6
    )


def slices(boxes, view):
    corners = (
        np.asarray(side).astype(int).reshape(len(SIZES), -1)[view]
        for side in (boxes.left, boxes.top, boxes.right, boxes.bottom)
    )
    return [(slice(y0, y1), slice(x0, x1)) for x0, y0, x1, y1 in zip(*corners, strict=True)]


def test_boxes__area_counts_pixels(boxes):
    areas = np.asarray(boxes.area).reshape(len(SIZES), -1)
    for view, (width, height) in enumerate(SIZES):
        ones = np.ones((height, width))
        assert_array_equal(areas[view], [ones[box].sum() for box in slices(boxes, view)])
        assert_array_equal(boxes.of_view(view).area, areas[view])
    assert not areas[:, 7].any()
    assert_array_equal(boxes.total(boxes.area), areas.sum(axis=0))


def test_union__is_the_blocks_that_the_chosen_boxes_touch(boxes):
    chosen = np.arange(100).reshape(2, 50) % 3 == 0
    for view, ((width, height), blocks) in enumerate(zip(SIZES, boxes.union(chosen), strict=True)):
        expected = np.zeros((height, width), bool)
        for box in np.array(slices(boxes, view), object)[chosen[view]]:
            expected[tuple(box)] = True
        grid = BlockGrid(width, height, block_shape(RenderConfig()))
        rows, columns = grid.shape
        assert_array_equal(blocks[:rows, :columns], grid.counts(expected) > 0)
        assert blocks.sum() == blocks[:rows, :columns].sum()


@pytest.mark.parametrize("factor", [1, 2])
def test_within__counts_pixels_in_the_blocks_of_reduced_views(boxes, factor):
    rng = np.random.default_rng(2)
    regions = [
        Region.of(rng.random((height // factor, width // factor)) < 0.02, RenderConfig())
        for width, height in SIZES
    ]
    masks = stacked([region.drawn for region in regions])
    counts = boxes.within(masks, factor * boxes.sides)
    for view, region in enumerate(regions):
        blocks = region.mask.repeat(factor, 0).repeat(factor, 1)
        expected = [blocks[box].sum() for box in slices(boxes, view)]
        assert 0 < np.mean(expected) < np.asarray(boxes.of_view(view).area).mean()
        assert_allclose(np.reshape(counts, (2, -1))[view], expected, atol=0.05)

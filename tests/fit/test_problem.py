"""The problem of a first frame, and the views that it consists of."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi import RenderConfig
from morgs_mi.core.rig import scene_extent
from morgs_mi.core.view import View
from morgs_mi.fit.far_views import PointCloud
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.fit.view import mean_psnr, withheld_blocks
from tests.scenes.ball import ball, bytes_of, images_of, opaque_ball, problem, views
from tests.scenes.cameras import look_at_cameras

LARGE = look_at_cameras([(0, 0, -4)], 40, 160, 120)[0]


def large_view(mask=None):
    """Return a view of 160x120 pixels, all of them white in even columns."""
    return View(
        LARGE,
        np.uint8(255 * np.tile(np.arange(160) % 2, (120, 1)))[..., None].repeat(3, axis=2),
        mask,
    )


def test_first_frame_problem__starts_from_the_points_with_the_settings_of_the_fit():
    positions = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3))
    points = PointCloud(positions, np.full((300, 3), 0.25))
    config = FitConfig(sh_degree=2, num_gaussians=100, density=DensityConfig(rounds=1))
    views_of_ball = [
        View(*view) for view in zip(views(), bytes_of(images_of(opaque_ball())), strict=True)
    ]
    result = FirstFrameProblem.of(
        views_of_ball, points, config, RenderConfig(), np.random.default_rng(0)
    )
    assert (len(result.start), result.start.sh_degree) == (50, 2)  # half, as it grows to all
    assert_allclose(result.start.opacities, 0.3, rtol=1e-6)
    assert result.points is positions
    assert result.extent == scene_extent(views())
    assert [camera.name for camera in result.cameras] == [camera.name for camera in views()]


def test_mean_psnr__does_not_count_masked_pixels():
    images = bytes_of(images_of(opaque_ball()))
    mask = np.ones((48, 64), bool)
    mask[:20] = False
    every = {"masks": [mask] * 4}
    spoiled = [np.where(mask[..., None], image, 255) for image in images]
    views, spoiled_views, unmasked_views = (
        problem(pictures, **masks).views
        for pictures, masks in ((images, every), (spoiled, every), (spoiled, {}))
    )
    nothing = replace(views[0], mask=~mask & mask)
    masked = [
        mean_psnr(ball(80), some, RenderConfig())
        for some in (views, spoiled_views, (*views, nothing))
    ]
    assert masked[0] == masked[1] == masked[2]
    assert np.isnan(mean_psnr(ball(80), [nothing], RenderConfig()))
    assert masked[0] > mean_psnr(ball(80), unmasked_views, RenderConfig()) + 3


@pytest.mark.parametrize(
    ("width", "size"),
    [(160, (160, 120)), (81, (160, 120)), (80, (80, 60)), (50, (53, 40)), (10, (160, 120))],
)
def test_view__is_reduced_by_a_whole_factor_to_no_less_than_a_width(width, size):
    # A reduced image has 32 pixels at least on each side.
    view = large_view().reduced(width)
    assert view.camera.size == size == view.image.shape[1::-1]
    assert view.mask is None
    assert view.image.mean() == pytest.approx(127.5, abs=1)
    assert_allclose(view.camera.K, np.diag([size[0] / 160, size[1] / 120, 1]) @ LARGE.K)


def test_view__reduced_pixels_are_valid_if_all_that_they_cover_are():
    mask = np.ones((120, 160), bool)
    mask[7, 10] = mask[60:63, 80:85] = False
    reduced = large_view(mask).reduced(80).mask
    assert_array_equal(reduced, mask.reshape(60, 2, 80, 2).all(axis=(1, 3)))


def test_withheld_blocks__divide_the_valid_pixels():
    valid = np.arange(160) < 120 * np.ones((120, 1))
    rest, unseen = withheld_blocks([large_view(), large_view(valid)], 160, np.random.default_rng(0))
    for allowed, a, b in zip((np.ones_like(valid), valid), rest, unseen, strict=True):
        assert_array_equal(a.mask ^ b.mask, allowed)
        assert not (a.mask & b.mask).any()
        assert b.mask.sum() / allowed.sum() == pytest.approx(1 / 8, abs=0.06)


def test_withheld_blocks__reduce_each_view_to_the_least_width():
    views = [large_view(), large_view().reduced(80), large_view()]
    rest, _ = withheld_blocks(views, 80, np.random.default_rng(0))
    assert [view.camera.width for view in rest] == [80, 80, 80]


def test_first_frame_problem__has_an_extent_of_a_sixth_of_the_depth_at_least():
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))

    def extent(spread):
        cameras = look_at_cameras([(x, 0, -12) for x in (-spread, spread)], 40)
        black_views = [View(camera, np.zeros((48, 64, 3), np.uint8)) for camera in cameras]
        cloud = PointCloud(points, np.full_like(points, 0.5))
        rng = np.random.default_rng(0)
        config = FitConfig(num_gaussians=50)
        return FirstFrameProblem.of(black_views, cloud, config, RenderConfig(), rng).extent

    assert extent(0.1) == pytest.approx(12 / 6, rel=0.1)
    assert extent(5.0) == pytest.approx(1.1 * 5.0)

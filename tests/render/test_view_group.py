"""Views that are drawn together, against the same views drawn one by one."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Gaussians, RenderConfig, rasterize
from morgs_mi.core.arrays import from_numpy
from morgs_mi.render.active_view import ActiveView, ViewGroup, backproject
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.scenes.cameras import make_camera, make_wide_camera
from tests.scenes.gaussians import as_float32, make_scene, make_wide_scene, to_gaussians
from tests.scenes.views import make_active_view

N = 120
ACTIVE = np.arange(0, 120, 5)


@pytest.fixture(scope="module")
def gaussians():
    return Gaussians(**make_wide_scene(N))


def moved(camera, x):
    """Return a camera that is displaced sideways."""
    viewmat = np.array(camera.viewmat)
    viewmat[0, 3] += x
    return replace(camera, viewmat=viewmat)


def views_of(gaussians):
    """Return views of several sizes: in part, as a whole, with a rolling shutter, and without
    static Gaussians.
    """
    wide = make_wide_camera()
    static = gaussians.select(~np.isin(np.arange(N), ACTIVE))
    cameras = [
        wide,
        moved(wide, 0.1),
        wide.resized(90, 37),
        replace(moved(wide, -0.2), delay=0.4, readout=0.3),
    ]
    views = []
    for k, camera in enumerate(cameras):
        y, x = np.mgrid[: camera.height, : camera.width]
        mask = (x - 30) ** 2 + (y - 20) ** 2 < (10 + 5 * k) ** 2
        views.append(
            make_active_view(camera, Region.of(mask), static, ("color", "motion"), RenderConfig())
        )
    none = make_active_view(
        cameras[1], views[1].region, static.select(slice(0)), (), RenderConfig()
    )
    return [*views, ActiveView(wide), none]


def split(group, image):
    """Return the image of each view on its region from an image of a group."""
    return np.split(image, np.cumsum([view.drawn.num_blocks for view in group.views])[:-1])


@pytest.mark.slow
def test_view_group__draws_what_each_view_draws(gaussians):
    views = views_of(gaussians)
    active = gaussians.select(ACTIVE)
    group = ViewGroup(views)
    drawing = group.draw(active)
    images = split(group, np.asarray(drawing.color).reshape(group.region.shape(3)))
    weights = [
        np.random.default_rng(k).normal(size=view.drawn.shape(2)) for k, view in enumerate(views)
    ]
    sums = drawing.sums(from_numpy(mi.Float, np.concatenate(weights)), 2)
    for view, image, weight, part in zip(views, images, weights, sums, strict=True):
        blocks = replace(view, region=view.drawn)
        assert_close(image, np.asarray(render_view(active, blocks).color), rtol=1e-6, atol=1e-6)
        assert_close(part, backproject(active, blocks, np.float32(weight)), rtol=1e-5, atol=1e-4)


def test_view_group__of_gaussians_that_no_view_shows_is_black(gaussians):
    group = ViewGroup([ActiveView(make_wide_camera())])
    drawing = group.draw(replace(gaussians, means=gaussians.means - 1e3))
    ones = from_numpy(mi.Float, np.ones(group.region.shape(1)))
    for values in (drawing.color, drawing.sums(ones, 1), drawing.totals(ones, 1)):
        assert not np.asarray(values).any()


def test_totals__are_the_sums_over_all_views(gaussians):
    group = ViewGroup(views_of(gaussians))
    drawing = group.draw(gaussians)
    image = from_numpy(mi.Float, np.random.default_rng(0).normal(size=group.region.shape(2)))
    assert_close(drawing.totals(image, 2), drawing.sums(image, 2).sum(axis=0), rtol=1e-5)


def test_backproject__is_the_transpose_of_blending():
    """<image, sum_i w_i c_i> = sum_i c_i <image, w_i> for the confidence channel, which is plain
    blending.
    """
    raw = as_float32(make_scene())
    camera = make_camera()
    gaussians = to_gaussians(raw)
    image = (
        np.random.default_rng(0).normal(size=(camera.height, camera.width, 1)).astype(np.float32)
    )
    sums = backproject(gaussians, ActiveView(camera), image)
    blended = np.asarray(rasterize(gaussians, camera, ("confidence",)).confidence, np.float64)
    confidence = 1 / (1 + np.exp(-raw["logit_confidence"]))
    assert np.vdot(sums[:, 0], confidence) == pytest.approx(
        np.vdot(blended, image), rel=tol.DUALITY_REL
    )

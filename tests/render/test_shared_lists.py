"""Lists that several renderings share: the same images and gradients as with lists of their own."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import RenderConfig
from morgs_mi.render.active_view import (
    ActiveView,
    ViewGroup,
    lists_of_views,
    narrowed,
    view_groups,
)
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.scenes.ball import opaque_ball
from tests.scenes.cameras import QUAD, look_at_cameras

CHANNELS = ("color", "alpha", "depth")
STATIC = np.arange(250)
ACTIVE = np.arange(250, 400)


def views_of_unequal_sizes(static):
    """Return a whole view, two regions and a view without static splats."""
    cameras = look_at_cameras(QUAD[:2], 40) + look_at_cameras(QUAD[2:], 40, 76, 52)
    drawn = [np.zeros((camera.height, camera.width), bool) for camera in cameras]
    drawn[1][5:30, 4:28] = drawn[2][9:40, 11:60] = drawn[3][:20, :20] = True
    regions = [None, *(Region.of(mask) for mask in drawn[1:])]
    views = [
        ActiveView(camera, region=region) for camera, region in zip(cameras, regions, strict=True)
    ]
    return dict(enumerate([*ViewGroup(views[:3]).with_static(static, CHANNELS), views[3]]))


def rendered(gaussians, view):
    """Return the images of a view, and the gradients of a weighted sum of its colour."""
    gaussians = gaussians.detached()
    dr.enable_grad(gaussians.means, gaussians.logit_opacities)
    image = render_view(gaussians, view, CHANNELS)
    weight = np.random.default_rng(0).normal(size=image.color.shape).astype(np.float32)
    dr.backward(image.color * mi.TensorXf(weight))
    arrays = [*(image[name] for name in CHANNELS)]
    arrays += [dr.grad(gaussians.means), dr.grad(gaussians.logit_opacities)]
    return [np.array(array) for array in arrays]


@pytest.mark.parametrize("most", [1, 4])
def test_lists__give_the_same_images_and_gradients(most):
    scene = opaque_ball()
    active = scene.select(ACTIVE)
    views = views_of_unequal_sizes(scene.select(STATIC))
    lists = lists_of_views(view_groups(views, most), active, 1.0)
    for v, view in views.items():
        own = rendered(active, view)
        shared = rendered(active, replace(view, lists=lists[v]))
        for expected, result in zip(own, shared, strict=True):
            assert np.abs(expected).max() > 0
            assert_close(result, expected, atol=tol.SUM_ORDER_REL * np.abs(expected).max())


def test_lists__hold_while_splats_move_by_less_than_the_margin():
    scene = opaque_ball()
    views = views_of_unequal_sizes(scene.select(STATIC))
    active = scene.select(ACTIVE)
    pixel = 0.02  # in world units: less than 1.5 px in each view
    moved = replace(active, means=active.means + mi.TensorXf(np.float32([[pixel, -pixel, 0]])))
    groups = view_groups(views, 4)
    lists = [lists_of_views(groups, active, margin) for margin in (0.0, 2.0, 20.0)]
    errors = []
    for v, view in views.items():
        images = [np.array(render_view(moved, replace(view, lists=x[v])).color) for x in lists]
        errors.append([np.abs(image - images[-1]).max() for image in images])
    none, enough, _ = np.max(errors, axis=0)
    assert none > 1e-3
    assert enough < 1e-6


def test_lists__are_empty_where_nothing_is_seen():
    scene = opaque_ball()
    (camera,) = look_at_cameras(QUAD[:1], 40)
    view = ActiveView(camera)
    behind = replace(scene, means=np.asarray(scene.means) + 10 * np.asarray(camera.position))
    (lists,) = ViewGroup([view]).lists(behind, 1.0)
    image = render_view(behind, replace(view, lists=lists), CHANNELS)
    assert_array_equal(np.array(image.color), 0)


def test_lists__are_dropped_where_a_view_is_narrowed():
    scene = opaque_ball()
    (camera,) = look_at_cameras(QUAD[:1], 40)
    (lists,) = ViewGroup([ActiveView(camera)]).lists(scene, 1.0)
    view = ActiveView(camera, RenderConfig(), lists=lists)
    blocks = np.zeros(view.grid.shape, bool)
    blocks[0, 0] = True
    assert narrowed({0: view}, blocks[None])[0].lists is None

"""Responsibility: against the exact ratio of blend weights."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi import RenderConfig
from morgs_mi.method.active_set import ChangedView, ChangedViews, overlap, responsibility
from morgs_mi.render.active_view import ActiveView, backproject
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet

RENDER = RenderConfig()
WALL = 400
SIDE = 96
CAMERAS = dict(
    enumerate(look_at_cameras(arc(np.linspace(-0.6, 0.6, 5), 4, y=-0.3), 40, SIDE, SIDE))
)


@pytest.fixture(scope="module")
def gaussians():
    """Return a wall, and in front of it the 60 Gaussians of a ball."""
    rng = np.random.default_rng(0)
    means = np.concatenate([random_sheet(rng, WALL, 2, 1.0), rng.normal(size=(60, 3)) * 0.12])
    sizes = np.where(np.arange(len(means)) < WALL, 0.12, 0.06)
    return isotropic(means, sizes, 0.95, np.zeros((len(means), 1, 3)))


def changed_views(gaussians, changes):
    views = [ChangedView(CAMERAS[view], change=change) for view, change in changes.items()]
    return ChangedViews.of(gaussians, views, RENDER)


def responsibility_for(gaussians, changes, width=640):
    return responsibility(gaussians, changed_views(gaussians, changes), width)


def exact_ratio(gaussians, changes):
    """Return the ratio of blend weights over whole views, and their sum in px."""
    images = {
        view: np.stack([c, np.ones_like(c)], axis=-1).astype(np.float32)
        for view, c in changes.items()
    }
    sums = sum(
        backproject(gaussians, ActiveView(CAMERAS[view]), image).astype(float)
        for view, image in images.items()
    )
    return sums[:, 0] / np.maximum(sums[:, 1], 1e-9), sums[:, 1]


def ball_moves():
    """Return masks of a disc around the centre of each view, where the ball is."""
    y, x = np.mgrid[:SIDE, :SIDE]
    centers = {view: camera.project(np.zeros((1, 3)))[0][0] for view, camera in CAMERAS.items()}
    return {view: (x - u) ** 2 + (y - v) ** 2 < 12**2 for view, (u, v) in centers.items()}


@pytest.mark.parametrize("width", [SIDE, SIDE // 2])
def test_responsibility__is_close_to_the_exact_ratio(gaussians, width):
    ratio = responsibility_for(gaussians, ball_moves(), width)
    exact, weight = exact_ratio(gaussians, ball_moves())
    visible = weight > 5
    assert visible[WALL:].sum() > 30
    assert np.all(ratio[WALL:][visible[WALL:]] > 0.4)
    assert np.corrcoef(ratio[visible], exact[visible])[0, 1] > 0.95
    assert np.mean(np.abs(ratio - exact)[visible]) < 0.05


def test_responsibility__is_small_for_a_background_that_other_views_see(gaussians):
    """The disc covers another part of the wall in each view."""
    assert np.mean(responsibility_for(gaussians, ball_moves())[:WALL] > 0.3) < 0.05


def test_responsibility__is_zero_for_hidden_gaussians(gaussians, monkeypatch):
    everything = {view: np.full((SIDE, SIDE), True) for view in CAMERAS}
    some = responsibility_for(gaussians, everything) > 0
    monkeypatch.setattr("morgs_mi.method.active_set.MIN_WEIGHT", 20.0)
    fewer = responsibility_for(gaussians, everything) > 0
    assert fewer.sum() < some.sum()
    _, weight = exact_ratio(gaussians, everything)
    assert not fewer[weight < 10].any()


def test_overlap__counts_hidden_gaussians_and_only_views_in_which_they_are(gaussians):
    changes = {view: np.full((SIDE, SIDE), view == 0) for view in CAMERAS}
    views = changed_views(gaussians, changes)
    areas = np.reshape(views.boxes.area, (len(CAMERAS), -1))
    expected = np.where(areas[0] > 0, 1 / np.maximum((areas > 0).sum(axis=0), 1), 0)
    assert_allclose(overlap(views), expected, atol=1e-5)

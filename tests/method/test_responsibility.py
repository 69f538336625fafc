"""Responsibility: against the exact ratio of blend weights."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi import RenderConfig
from morgs_mi.method.boxes import boxes_around
from morgs_mi.method.responsibility import responsibility
from morgs_mi.render.backproject import backproject
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet

RENDER, CORE, WALL, SIDE = RenderConfig(), 0.6, 400, 96
CAMERAS = dict(enumerate(look_at_cameras(arc(np.linspace(-0.6, 0.6, 5), 4, y=-0.3), 40, SIDE, SIDE)))


@pytest.fixture(scope="module")
def gaussians():
    """Return a wall, and in front of it the 60 Gaussians of a ball."""
    rng = np.random.default_rng(0)
    means = np.concatenate([random_sheet(rng, WALL, 2, 1.0), rng.normal(size=(60, 3)) * 0.12])
    sizes = np.where(np.arange(len(means)) < WALL, 0.12, 0.06)
    return isotropic(means, sizes, 0.95, np.zeros((len(means), 1, 3)))


def responsibility_for(gaussians, changes):
    boxes = {view: boxes_around(gaussians, camera, RENDER, CORE) for view, camera in CAMERAS.items()}
    return responsibility(gaussians, CAMERAS, changes, boxes, RENDER)


def exact_ratio(gaussians, changes):
    """Return the ratio of blend weights over whole views, and their sum in px."""
    images = {view: np.stack([c, np.ones_like(c)], axis=-1).astype(np.float32) for view, c in changes.items()}
    sums = sum(backproject(gaussians, CAMERAS[view], image).astype(float) for view, image in images.items())
    return sums[:, 0] / np.maximum(sums[:, 1], 1e-9), sums[:, 1]


def ball_moves():
    """Return masks of a disc around the centre of each view, where the ball is."""
    y, x = np.mgrid[:SIDE, :SIDE]
    centers = {view: camera.project(np.zeros((1, 3)))[0][0] for view, camera in CAMERAS.items()}
    return {view: (x - u) ** 2 + (y - v) ** 2 < 12**2 for view, (u, v) in centers.items()}


def test_responsibility__is_close_to_the_exact_ratio(gaussians):
    found, (exact, weight) = responsibility_for(gaussians, ball_moves()), exact_ratio(gaussians, ball_moves())
    visible = (weight > 5) & (found.visible > 0)
    assert visible[WALL:].sum() > 30
    assert np.all(found.share[WALL:][visible[WALL:]] > 0.4)
    assert np.corrcoef(found.share[visible], exact[visible])[0, 1] > 0.95
    assert np.mean(np.abs(found.share - exact)[visible]) < 0.05


def test_responsibility__is_small_for_a_background_that_other_views_see(gaussians):
    """The disc covers another part of the wall in each view."""
    share = responsibility_for(gaussians, ball_moves()).share
    assert np.mean(share[:WALL] > 0.3) < 0.05


@pytest.mark.parametrize("changed", [False, True])
def test_responsibility__is_zero_or_one_where_nothing_or_everything_changed(gaussians, changed):
    found = responsibility_for(gaussians, {view: np.full((SIDE, SIDE), changed) for view in CAMERAS})
    seen = found.visible > 0
    assert seen.any() == changed
    np.testing.assert_allclose(found.share[seen], 1, atol=1e-5)
    assert not found.share[~seen].any()

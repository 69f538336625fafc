"""The active set: which Gaussians all views select, and that a frame fitted with it equals one
fitted in full.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import RenderConfig, rasterize
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.method.active_set import (
    ActiveSet,
    ChangedView,
    find_active_set,
    full_active_set,
)
from morgs_mi.method.motion_config import MotionConfig
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet
from tests.scenes.views import observed

RENDER = RenderConfig()
PLACE = "morgs_mi.method.active_set"
EXTENT = 3.0
V = 5
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)
HIDDEN = 300  # the wall's Gaussians come first


def cameras():
    return dict(enumerate(look_at_cameras(arc(np.linspace(-0.6, 0.6, V), 4, y=-0.3), 40, 128, 96)))


def scene(shift=0.0, colors=None):
    """Return a wall, and in front of it a ball of 60 Gaussians that is shifted along x."""
    rng = np.random.default_rng(0)
    wall = random_sheet(rng, HIDDEN, 2, 1.0)
    ball = rng.normal(size=(60, 3)) * 0.12 + (shift, 0, 0)
    means = np.concatenate([wall, ball])
    sh = 0.6 * np.sin(3 * means[:, None, :] + (0, 1, 2)) if colors is None else colors
    sizes = np.where(np.arange(len(means)) < HIDDEN, 0.15, 0.06)
    return isotropic(means, sizes, 0.95, sh, logit_confidence=np.zeros(len(means)))


def images_of(gaussians):
    return [
        np.asarray(rasterize(gaussians, camera, ("color",)).color) for camera in cameras().values()
    ]


def fit(previous, active, images, config):
    problem = FrameProblem(previous, active, observed(active.views, images), None, EXTENT)
    return fit_later_frame(problem, config, PLAIN, np.random.default_rng(0))


@pytest.fixture(scope="module")
def previous():
    return scene()


@pytest.fixture(scope="module")
def current(previous):
    return scene(0.08, np.asarray(previous.sh_coeffs))


def changes(previous, current):
    pairs = zip(images_of(previous), images_of(current), strict=True)
    return {view: np.abs(b - a).max(-1) > 0.02 for view, (a, b) in enumerate(pairs)}


def found(gaussians, changed):
    views = {v: ChangedView(camera, change=changed[v]) for v, camera in cameras().items()}
    active = find_active_set(gaussians, views, RENDER)
    return active.with_static(gaussians, ("color",))


def test_find_active_set__selects_moving_but_not_occluded_gaussians(previous, current, monkeypatch):
    monkeypatch.setattr(f"{PLACE}.MIN_RESPONSIBILITY", 0.1)  # half of one of the five views
    active = found(previous, changes(previous, current))
    mask = np.isin(np.arange(len(previous)), active.indices)
    assert mask[HIDDEN:].mean() > 0.9  # the others are inside the ball
    assert mask[:HIDDEN].mean() < 0.15
    assert len(active.views) == V
    assert active.fractions["pixels"] < 0.4
    assert active.fractions["gaussians"] == mask.mean()


def test_find_active_set__is_empty_without_changes(previous):
    nothing = {view: np.zeros((96, 128), bool) for view in range(V)}
    active = found(previous, nothing)
    assert not active.views
    assert active.fractions == {"gaussians": 0, "views": 0, "pixels": 0}
    fitted = fit(previous, active, [], FitConfig(sh_degree=0))
    assert fitted.steps == 0
    assert np.array_equal(fitted.gaussians.means, previous.means)
    assert not np.asarray(fitted.gaussians.motion).any()


def test_find_active_set__covers_what_appears_in_front_of_a_static_wall(previous):
    """The ball is new: no Gaussian is there, and every view sees it before another part of the
    wall.
    """
    wall = previous.select(np.arange(HIDDEN))
    active = found(wall, changes(wall, previous))
    covered = [active.views[view].region.mask for view in range(V)]
    for change, drawn in zip(changes(wall, previous).values(), covered, strict=True):
        assert drawn[change].mean() > 0.9


def test_find_active_set__draws_what_hardly_changed_in_some_views_only(
    previous, current, monkeypatch
):
    changed = changes(previous, current)

    def drawn(quiet_views, quiet=0.9):
        monkeypatch.setattr(f"{PLACE}.QUIET", quiet)
        monkeypatch.setattr(f"{PLACE}.QUIET_VIEWS", quiet_views)
        active_set = found(previous, changed)
        return active_set, {view: active_set.views[view].region.mask for view in range(V)}

    every, everywhere = drawn(V)
    some, masks = drawn(2)
    assert np.array_equal(some.indices, every.indices)
    fewer = [view for view in range(V) if masks[view].sum() < everywhere[view].sum()]
    assert len(fewer) == V - 2
    assert all(masks[view][changed[view]].all() for view in range(V))
    assert drawn(2, 0.0)[0].fractions == every.fractions


def test_find_active_set__keeps_what_moved_for_one_more_frame(previous):
    """Its confidence can fall in that frame."""
    logits = np.where(np.arange(len(previous)) == 7, 2.0, -2.0)
    nothing = {view: np.zeros((96, 128), bool) for view in range(V)}
    previous_gaussians = replace(previous, logit_confidence=logits)
    assert found(previous_gaussians, nothing).indices.tolist() == [7]


@pytest.mark.parametrize("grows", [False, True])
def test_fit_later_frame__with_the_active_set_equals_the_full_fit(previous, current, grows):
    """Error of the moved image, and the survivors: static Gaussians are unchanged to the bit."""
    density = DensityConfig(later_frames=grows, births=0.05, min_error=0)
    config = FitConfig(sh_degree=0, epochs=12, density=density)
    truth = images_of(current)
    active = found(previous, changes(previous, current))
    whole = fit(previous, full_active_set(previous, cameras(), RENDER), truth, config)
    fitted = fit(previous, active, truth, config)
    start_error, whole_error, error = (
        np.sqrt(np.square(np.subtract(images_of(gaussians), truth)).mean())
        for gaussians in (previous, whole.gaussians, fitted.gaussians)
    )
    assert whole_error < 0.4 * start_error
    # Half a dB; it is better where the full fit disturbs what was right.
    assert error < 1.06 * whole_error
    survivors = fitted.source[fitted.source >= 0]
    assert np.array_equal(survivors, np.unique(survivors))
    assert (fitted.source == -1).any() == grows
    still = np.setdiff1d(np.arange(len(previous)), active.indices)
    where = np.searchsorted(survivors, still)
    assert not np.asarray(fitted.gaussians.motion)[where].any()
    assert not np.asarray(fitted.gaussians.offset)[where].any()
    for attribute in ("means", "quats", "log_scales", "sh_coeffs", "logit_opacities"):
        values = np.asarray(getattr(fitted.gaussians, attribute))[where]
        assert np.array_equal(values, np.asarray(getattr(previous, attribute))[still]), attribute


def test_merge__has_the_order_of_the_previous_frame_and_births_last():
    sheet = isotropic(np.arange(15.0).reshape(5, 3), 0.1, 0.9, np.zeros((5, 1, 3)))
    sheet = replace(sheet, motion=np.ones((5, 3)), offset=np.ones((5, 3)))
    active = ActiveSet(np.array([1, 3]), 5, {}, 0)
    fitted = sheet.select([3, 0])  # the first active one died, and another one was born
    merged, source = active.merge(sheet, fitted, np.array([1, -1]))
    assert source.tolist() == [0, 2, 3, 4, -1]
    assert_array_equal(np.asarray(merged.means), np.asarray(sheet.means)[[0, 2, 3, 4, 0]])
    assert np.asarray(merged.motion)[:, 0].tolist() == [0, 0, 1, 0, 1], "static ones have no motion"

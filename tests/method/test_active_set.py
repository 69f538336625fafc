"""Who may change is told by all views together, and a frame that is fitted so is the frame that is fitted whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.fit.config import DensityConfig, FitConfig
from morgs_mi.fit.later_frame import fit_later_frame
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import find_active_set, full_active_set
from morgs_mi.method.config import MotionConfig

RENDER, EXTENT, V = RenderConfig(), 3.0, 5
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)
CHANNELS = [("color",)] * V
HIDDEN = 300  # the wall's Gaussians come first


def cameras() -> list[Camera]:
    angles = np.linspace(-0.6, 0.6, V)
    return [Camera.look_at((4 * np.sin(a), -0.3, -4 * np.cos(a)), (0, 0, 0), (0, -1, 0), 40, 128, 96) for a in angles]


def scene(shift=0.0, colors=None) -> Gaussians:
    """A wall, and before it a ball of 60 Gaussians that may be shifted."""
    rng = np.random.default_rng(0)
    wall = np.stack([*rng.uniform(-2, 2, (2, HIDDEN)), np.full(HIDDEN, 1.0)], axis=1)
    ball = rng.normal(size=(60, 3)) * 0.12 + (shift, 0, 0)
    means = np.concatenate([wall, ball])
    sh = 0.6 * np.sin(3 * means[:, None, :] + (0, 1, 2)) if colors is None else colors
    sizes = np.where(np.arange(len(means)) < HIDDEN, 0.15, 0.06)
    quats = np.tile([1.0, 0, 0, 0], (len(means), 1))
    opacities = np.full(len(means), 0.95)
    return Gaussians.from_activated(
        means, np.repeat(sizes[:, None], 3, 1), quats, opacities, sh, logit_confidence=np.zeros(len(means))
    )


def pictures(gaussians: Gaussians) -> list[np.ndarray]:
    return [np.asarray(rasterize(gaussians, camera, ("color",)).color) for camera in cameras()]


@pytest.fixture(scope="module")
def before() -> Gaussians:
    return scene()


@pytest.fixture(scope="module")
def after(before) -> Gaussians:
    return scene(0.08, np.asarray(before.sh_coeffs))


def changes(before, after) -> list[np.ndarray]:
    return [np.abs(b - a).max(-1) > 0.02 for a, b in zip(pictures(before), pictures(after), strict=True)]


def test_who_moves_takes_part_and_who_is_hidden_now_and_then_does_not(before, after):
    part = find_active_set(before, cameras(), changes(before, after), CHANNELS, RENDER)
    chosen = np.isin(np.arange(len(before)), part.indices)
    assert chosen[HIDDEN:].mean() > 0.9
    assert chosen[:HIDDEN].mean() < 0.1
    assert len(part.views) == V
    assert part.fractions["pixels"] < 0.4
    assert part.fractions["gaussians"] == chosen.mean()


def test_nothing_has_changed(before):
    nothing = [np.zeros((96, 128), bool)] * V
    part = find_active_set(before, cameras(), nothing, CHANNELS, RENDER)
    assert not part.views
    assert part.fractions == {"gaussians": 0, "views": 0, "pixels": 0}
    fitted = fit_later_frame(before, part, {}, {}, EXTENT, FitConfig(sh_degree=0), PLAIN, np.random.default_rng(0))
    assert fitted.epochs == 0
    assert np.array_equal(fitted.gaussians.means, before.means)
    assert not np.asarray(fitted.gaussians.motion).any()


def test_what_appears_before_a_still_wall_wakes_it(before):
    """The ball is new: no Gaussian is there, and every view sees it before another part of the wall."""
    wall = before.select(np.arange(HIDDEN))
    part = find_active_set(wall, cameras(), changes(wall, before), CHANNELS, RENDER)
    covered = []
    for view in range(V):
        region = part.views[view].region
        covered.append(region.paste(np.ones(region.shape(1)[:3]), np.zeros((96, 128))))
    for change, drawn in zip(changes(wall, before), covered, strict=True):
        assert drawn[change].mean() > 0.9


@pytest.mark.parametrize("grows", [False, True])
def test_a_part_is_fitted_as_the_whole_is(before, after, grows):
    """Error of the moved picture, and who is there: what stands still is as it was, to the bit."""
    density = DensityConfig(later_frames=grows, births=0.05, min_error=0)
    config, truth = FitConfig(sh_degree=0, epochs=12, density=density), pictures(after)
    part = find_active_set(before, cameras(), changes(before, after), CHANNELS, RENDER)
    errors = {}
    for name, some in (("whole", full_active_set(before, cameras(), RENDER)), ("part", part)):
        targets = {view: Target(image) for view, image in enumerate(truth)}
        fitted = fit_later_frame(before, some, targets, {}, EXTENT, config, PLAIN, np.random.default_rng(0))
        errors[name] = np.sqrt(np.mean([(a - b) ** 2 for a, b in zip(pictures(fitted.gaussians), truth, strict=True)]))
    start = np.sqrt(np.mean([(a - b) ** 2 for a, b in zip(pictures(before), truth, strict=True)]))
    assert errors["whole"] < 0.4 * start
    # Half a dB; it is better where the whole fit disturbs what was right.
    assert errors["part"] < 1.06 * errors["whole"]
    assert np.array_equal(fitted.source[fitted.source >= 0], np.unique(fitted.source[fitted.source >= 0]))
    assert (fitted.source == -1).any() == grows
    still = np.setdiff1d(np.arange(len(before)), part.indices)
    where = np.searchsorted(fitted.source[fitted.source >= 0], still)
    assert not np.asarray(fitted.gaussians.motion)[where].any()
    assert not np.asarray(fitted.gaussians.offset)[where].any()
    for attribute in ("means", "quats", "log_scales", "sh_coeffs", "logit_opacities"):
        kept = np.asarray(getattr(fitted.gaussians, attribute))[where]
        assert np.array_equal(kept, np.asarray(getattr(before, attribute))[still]), attribute


def test_a_frame_that_has_settled_ends_early(before):
    targets = {view: Target(image) for view, image in enumerate(pictures(before))}
    config = FitConfig(sh_degree=0, epochs=12, density=DensityConfig(later_frames=False), early_stopping_tolerance=0.0)
    whole = full_active_set(before, cameras(), RENDER)
    fitted = fit_later_frame(before, whole, targets, {}, EXTENT, config, PLAIN, np.random.default_rng(0))
    assert fitted.epochs == 12
    config = replace(config, density=DensityConfig(births=0.0))
    assert fit_later_frame(before, whole, targets, {}, EXTENT, config, PLAIN, np.random.default_rng(0)).epochs < 12

"""The first frame: schedule of steps, SH bands, growth and learning rates; losses, masks, and the
confidence.
"""

import dataclasses
from itertools import pairwise

import drjit as dr
import numpy as np
import pytest

from morgs_mi import RenderConfig
from morgs_mi.core.view import View
from morgs_mi.fit.first_frame import (
    MotionMask,
    density_rounds,
    fit_confidence,
    fit_first_frame,
)
from morgs_mi.fit.fit_config import DensityConfig, FitConfig, LearningRates
from morgs_mi.fit.view import rendered
from morgs_mi.method.objective import ObjectiveConfig
from morgs_mi.platform.progress import Progress
from morgs_mi.render.rasterize import render_view
from morgs_mi.testing import assert_close
from tests.scenes.ball import ball, images_of, opaque_ball, problem, views

NO_GROWTH = DensityConfig(rounds=0)
CONFIG = FitConfig(sh_degree=0, num_gaussians=80, first_frame_steps=8, density=NO_GROWTH)


def fit(images, start, config, seed=0, progress=None, limit=None, **changes):
    """Fit some or all of the views; `changes` are masks and the cut-offs of the renderer."""
    some = problem(images, start, **changes)
    rng = np.random.default_rng(seed)
    return fit_first_frame(some, config, rng, progress, limit=limit)


@pytest.fixture(scope="module")
def images():
    return images_of(opaque_ball())


@pytest.fixture
def drawn(monkeypatch):
    """A list to which every step of a fit adds the Gaussians and the width that it renders."""
    steps = []

    def spy(gaussians, view, *channels, **more):
        # Rounds of density control render without gradients.
        if dr.grad_enabled(gaussians.sh_coeffs):
            steps.append((gaussians.detached(), view.camera.width))
        return render_view(gaussians, view, *channels, **more)

    monkeypatch.setattr("morgs_mi.fit.first_frame.render_view", spy)
    # A recording renders in its own way, with the same result (see test_frozen_step).
    monkeypatch.setattr("morgs_mi.fit.first_frame.is_recordable", lambda *_: False)
    return steps


# ---- learning rates
# --------------------------------------------------------------------------------------

# L1 of white images and of colours that stay dark: their gradient is constant, so Adam's steps are
# as long as the rate.
COLOR_ALONE = LearningRates(means=0, scales=0, quats=0, opacities=0, sh_dc=0.05, sh_rest=0)
L1 = ObjectiveConfig(dssim_weight=0.0)
SCHEDULED = dataclasses.replace(CONFIG, first_frame_rates=COLOR_ALONE, objective=L1)
WHITE = [np.full((48, 64, 3), 255, np.uint8)]
DARK = dataclasses.replace(ball(80), sh_coeffs=np.full((80, 1, 3), -1.0))


def lengths(drawn, first_frame):
    """Return the length of each step of the colours."""
    shown = [*(gaussians for gaussians, _ in drawn), first_frame.gaussians]
    colors = np.array([np.asarray(gaussians.sh_coeffs) for gaussians in shown])
    return np.median(np.diff(colors, axis=0), axis=(1, 2, 3))


def test_fit_first_frame__skips_steps_to_keep_a_limit_of_the_clock(images, monkeypatch):
    clock = 0.0
    monkeypatch.setattr("morgs_mi.fit.first_frame.time.perf_counter", lambda: clock)
    config = dataclasses.replace(CONFIG, first_frame_steps=2000)
    done = []

    def report(stage, seconds, total):
        nonlocal clock
        clock += 0.1
        assert total == 60.0 or seconds > 60.0
        done.append(seconds)

    result = fit(images, ball(80), config, progress=Progress(report), limit=60.0)
    assert clock < 1.3 * 60
    assert 200 < result.steps < 700
    assert done == sorted(done)
    assert done[-1] >= 60.0


def test_fit_first_frame__reports_steps_in_proportion_to_their_time(images):
    """From the last round on, the images have twice the size in both directions."""
    done = []
    report = Progress(lambda stage, step, total: done.append(step))
    config = dataclasses.replace(CONFIG, density=DensityConfig(rounds=2), first_frame_steps=60)
    fit(images, ball(80), config, progress=report)
    early, late = np.diff(done)[[0, -1]]
    assert late == pytest.approx(2 * early)
    assert done[-1] == pytest.approx(60)


def test_fit_first_frame__lets_the_rates_fall_to_the_final_one(drawn):
    result = fit(WHITE, DARK, SCHEDULED)
    assert_close(lengths(drawn, result), 0.05 * 0.1 ** (np.arange(8) / 8), rtol=1e-4)


def test_fit_first_frame__moves_means_by_fractions_of_the_extent(images, drawn):
    rates = dataclasses.replace(CONFIG.first_frame_rates, means=1e-3)
    result = fit(
        images, ball(80), dataclasses.replace(CONFIG, first_frame_steps=1, first_frame_rates=rates)
    )
    shift = np.abs(np.asarray(result.gaussians.means) - np.asarray(drawn[0][0].means))
    # The extent is 3. The first step of Adam has the length of the rate where there is a gradient.
    assert np.median(shift) == pytest.approx(3e-3, rel=1e-3)


# ---- bands of the spherical harmonics
# --------------------------------------------------------------------


@pytest.mark.slow
def test_fit_first_frame__adds_sh_bands_at_equal_distances(images, drawn, monkeypatch):
    monkeypatch.setattr("morgs_mi.fit.first_frame.BAND", 0.15)
    config = dataclasses.replace(CONFIG, sh_degree=3, first_frame_steps=20)
    result = fit(images, ball(50, sh_degree=3), config)
    assert [gaussians.sh_degree for gaussians, _ in drawn] == 3 * [0] + 3 * [1] + 3 * [2] + 11 * [3]
    bands = np.abs(np.asarray(result.gaussians.sh_coeffs)).mean(axis=(0, 2))
    assert bands[1:4].mean() > bands[4:9].mean() > bands[9:].mean() > 0


@pytest.mark.slow
def test_fit_first_frame__has_all_sh_bands_after_one_step(images):
    result = fit(images, ball(50, sh_degree=3), FitConfig(sh_degree=3, first_frame_steps=1))
    assert result.gaussians.sh_degree == 3


# ---- growth
# ----------------------------------------------------------------------------------------------


def test_fit_first_frame__grows_in_the_rounds_alone_and_to_the_number_that_is_given(images, drawn):
    config = FitConfig(
        sh_degree=0, first_frame_steps=20, num_gaussians=100, density=DensityConfig(rounds=3)
    )
    result = fit(images, ball(60), config)
    counts = [len(gaussians) for gaussians, _ in drawn]
    assert (
        [step for step, (a, b) in enumerate(pairwise(counts), 1) if a != b]
        == density_rounds(config)
        == [2, 6, 10]
    )
    assert counts == sorted(counts)
    assert (counts[0], len(result.gaussians)) == (60, 100)
    black = [np.zeros_like(image) for image in images]
    invisible = dataclasses.replace(ball(60), sh_coeffs=np.full((60, 1, 3), -9.0))
    assert len(fit(black, invisible, config).gaussians) == 60, "no error is left"


def test_fit_first_frame__sees_images_of_half_the_size_until_it_has_grown(
    images, drawn, monkeypatch
):
    monkeypatch.setattr("morgs_mi.fit.view.COARSE_WIDTH", 32)
    monkeypatch.setattr("morgs_mi.core.view.MIN_SIDE", 24)
    config = dataclasses.replace(CONFIG, first_frame_steps=20, density=DensityConfig(rounds=3))
    fit(images, ball(60), config)
    fit(images, ball(60), CONFIG)
    assert [width for _, width in drawn] == 10 * [32] + 18 * [64]


def test_fit_first_frame__does_not_see_pixels_that_are_masked(images):
    mask = np.indices((48, 64))[0] > 15
    spoiled = [np.where(mask[..., None], image, 1) for image in images]
    results = [
        fit(pictures, ball(80), CONFIG, masks=[mask] * 4).gaussians.numpy()
        for pictures in (images, spoiled)
    ]
    assert all(np.array_equal(value, results[1][name]) for name, value in results[0].items())


# ---- images, masks and losses
# ----------------------------------------------------------------------------


def test_fit_first_frame__fits_views_of_different_sizes(images):
    start = problem(images, ball(80))
    camera = views()[1].resized(40, 30)
    small = View(camera, rendered(opaque_ball(), camera, RenderConfig()))
    mixed = dataclasses.replace(start, views=(start.views[0], small, *start.views[2:]))
    result = fit_first_frame(
        mixed, dataclasses.replace(CONFIG, first_frame_steps=60), np.random.default_rng(0)
    ).gaussians
    for view in mixed.views:
        errors = [
            np.abs(rendered(g, view.camera, RenderConfig()) - view.image).mean()
            for g in (ball(80), result)
        ]
        assert errors[1] < 0.5 * errors[0]


# ---- dropout, and what does not change
# ------------------------------------------------------------------


def test_fit_first_frame__leaves_gaussians_out_of_its_steps_but_not_of_the_result(images, drawn):
    result = fit(images, ball(80), dataclasses.replace(CONFIG, dropout=0.25))
    left_out = np.array([np.asarray(gaussians.opacities) < 1e-6 for gaussians, _ in drawn])
    assert left_out.mean() == pytest.approx(0.25, abs=0.05)
    assert len(np.unique(left_out, axis=0)) == len(drawn)  # others in each step
    assert np.asarray(result.gaussians.opacities).min() > 0.01


# ---- the confidence
# --------------------------------------------------------------------------------------


def learned(steps, masks):
    """Return the opaque ball with a confidence that follows motion masks."""
    config = dataclasses.replace(CONFIG, confidence_steps=steps)
    start = dataclasses.replace(opaque_ball(), logit_confidence=np.zeros(400))
    return fit_confidence(start, masks, config, RenderConfig(), np.random.default_rng(0))


def halves():
    """Return motion masks of two key views, which mark their right half."""
    mask = np.tile(np.arange(64) >= 32, (48, 1))
    return [MotionMask(views()[view], mask) for view in (0, 3)]


def test_fit_confidence__follows_the_masks_of_its_key_views():
    gaussians, losses = learned(40, halves())
    confidence = 1 / (1 + np.exp(-np.asarray(gaussians.logit_confidence)))
    place = np.asarray(gaussians.means)[:, 0]
    front = np.asarray(gaussians.means)[:, 2] < 0
    assert confidence[front & (place > 0.3)].mean() > 0.8
    assert confidence[front & (place < -0.3)].mean() < 0.2
    assert 0 < losses["mask"] < learned(4, halves())[1]["mask"]

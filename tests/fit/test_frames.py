"""The first frame and a later one: bands come in, Gaussians are born where they are missed, and are told apart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.config import DensityConfig, FitConfig
from morgs_mi.fit.first_frame import density_rounds, fit_first_frame
from morgs_mi.fit.initialise import from_points
from morgs_mi.fit.later_frame import fit_later_frame
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.config import MotionConfig

RENDER, EXTENT = RenderConfig(), 3.0
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)


def ball(n, sh_degree=0):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.8, 0.8, (n, 3))
    return from_points(points, 0.5 + 0.4 * np.sin(5 * points), sh_degree)


def views():
    origins = [(x, y, -3.5) for x in (-0.9, 0.9) for y in (-0.6, 0.6)]
    return [Camera.look_at(o, (0, 0, 0), (0, -1, 0), 40, 64, 48, name=f"cam{i}") for i, o in enumerate(origins)]


def pictures(gaussians):
    return [np.clip(np.asarray(rasterize(gaussians, c, ("color",)).color), 0, 1) for c in views()]


def quality(gaussians, images):
    return np.mean([psnr(a, b) for a, b in zip(pictures(gaussians), images, strict=True)])


@pytest.fixture(scope="module")
def truth():
    """A ball of 400 Gaussians, opaque enough to hide what is behind."""
    full = ball(400)
    return dataclasses.replace(full, logit_opacities=np.full(400, 2.0))


def first(images, start, config, seed=0):
    targets = [Target(image) for image in images]
    return fit_first_frame(start, views(), targets, EXTENT, config, RENDER, np.random.default_rng(seed))[0]


def test_births_make_up_for_a_start_with_too_few(truth):
    images, config = pictures(truth), FitConfig(sh_degree=0, first_frame_steps=160, num_gaussians=250)
    few = first(images, ball(60), dataclasses.replace(config, density=DensityConfig(rounds=0)))
    more = first(images, ball(60), config)
    assert len(few) == 60
    assert 150 < len(more) <= 250
    assert quality(more, images) > quality(few, images) + 1


def test_bands_come_in_one_after_the_other_and_all_are_there_at_the_end(truth):
    images = pictures(truth)
    for steps in (1, 40):
        found = first(images, ball(50, sh_degree=3), FitConfig(sh_degree=3, first_frame_steps=steps))
        assert found.sh_degree == 3
    bands = np.abs(np.asarray(found.sh_coeffs)).mean(axis=(0, 2))
    assert bands[1:4].mean() > bands[4:9].mean() > bands[9:].mean() > 0


def test_rounds_lie_between_a_tenth_and_a_half():
    steps = density_rounds(FitConfig(first_frame_steps=1000, density=DensityConfig(rounds=5)))
    assert steps == [100, 200, 300, 400, 500]
    assert density_rounds(FitConfig(density=DensityConfig(rounds=0))) == []


@pytest.mark.parametrize("motion", [PLAIN, MotionConfig(learn_motion=False)], ids=["plain", "gated"])
def test_a_later_frame_tells_who_is_new(truth, motion):
    """Half of the ball was not there before: births help, survivors keep their order, births come last."""
    images = pictures(truth)
    keep = np.flatnonzero(truth.numpy()["means"][:, 0] < 0.3)
    before = truth.select(keep)
    results = {}
    for births in (0.0, 0.3):
        density = DensityConfig(later_frames=True, births=births, min_error=0)
        fitted = fit_later_frame(
            before,
            full_active_set(before, views(), RENDER),
            {view: Target(image) for view, image in enumerate(images)},
            {},
            EXTENT,
            FitConfig(sh_degree=0, epochs=24, density=density),
            motion,
            np.random.default_rng(0),
        )
        found, source, losses = fitted.gaussians, fitted.source, fitted.losses
        survivors = source[source >= 0]
        assert len(source) == len(found)
        assert np.array_equal(survivors, np.unique(survivors))
        assert (source[len(survivors) :] == -1).all()
        assert (source == -1).sum() == round(births * len(before))
        assert np.isfinite(losses["recon"])
        raw = found.numpy()
        moved = raw["means"][: len(survivors)] - before.numpy()["means"][survivors]
        parts = (raw["motion"] + raw["offset"])[: len(survivors)]
        assert parts == pytest.approx(moved, abs=1e-6), "what moves a centre is told in its parts"
        assert raw["offset"].any() == motion.learn_offset
        results[births] = quality(found, images)
    assert results[0.3] > results[0.0] + 0.05  # dB; runs differ by 1e-5


def test_without_density_control_everybody_stays(truth):
    fitted = fit_later_frame(
        truth,
        full_active_set(truth, views(), RENDER),
        {view: Target(image) for view, image in enumerate(pictures(truth))},
        {},
        EXTENT,
        FitConfig(sh_degree=0, epochs=1, density=DensityConfig(later_frames=False)),
        PLAIN,
        np.random.default_rng(0),
    )
    assert isinstance(fitted.gaussians, Gaussians)
    assert np.array_equal(fitted.source, np.arange(400))


def test_nobody_is_born_when_no_step_is_left_to_fit_them(truth):
    config = FitConfig(sh_degree=0, epochs=1, density=DensityConfig(min_error=0))
    targets = {view: Target(image) for view, image in enumerate(pictures(truth))}
    before = truth.select(np.arange(200))
    part = full_active_set(before, views(), RENDER)
    fitted = fit_later_frame(before, part, targets, {}, EXTENT, config, PLAIN, np.random.default_rng(0))
    assert np.array_equal(fitted.source, np.arange(200))

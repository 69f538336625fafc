"""Cross-validation of the first frame: what it withholds, chooses and says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from morgs_mi import RenderConfig
from morgs_mi.fit.config import CrossValidationConfig, FitConfig
from morgs_mi.fit.cross_validation import (
    CrossValidation,
    Trial,
    cross_validate,
    trial_steps,
    withheld_views,
)
from morgs_mi.fit.view import View
from tests.scenes.ball import ball, images_of, opaque_ball, views
from tests.scenes.cameras import arc, look_at_cameras

CONFIG = FitConfig(sh_degree=0, first_frame_steps=100, num_gaussians=150)


def validate(images, masks=None, config=CONFIG, on_step=None, render=None):
    masks = [None] * len(images) if masks is None else masks
    given = [View(*view) for view in zip(views(), images, masks, strict=True)]
    return cross_validate(ball(80), given, 3.0, config, render or RenderConfig(), 0, on_step)


def bytes_of(images, noise=0.0):
    rng = np.random.default_rng(0)
    return [np.uint8(np.clip(255 * (image + rng.normal(0, noise, image.shape)) + 0.5, 0, 255)) for image in images]


def test_withheld_views__lie_in_the_inner_half_of_the_rig():
    cameras = look_at_cameras(arc(np.linspace(-0.8, 0.8, 13), 4), 40)
    chosen = withheld_views(cameras, 6)
    assert len(chosen) == 2
    assert all(3 <= view <= 9 for view in chosen)
    assert len(withheld_views(cameras[:3], 6)) == 1


def test_cross_validate__tries_candidates_until_one_is_no_better():
    done = []
    found = validate(bytes_of(images_of(opaque_ball())), on_step=done.append)
    values = [trial.withheld_psnr for trial in found.trials]
    assert len(values) == 3 or values[-1] <= values[-2]
    assert found.best.withheld_psnr == max(values)
    assert done == list(range(1, len(found.trials) * trial_steps(CONFIG) + 1))
    assert all(trial.training_psnr > trial.withheld_psnr > 15 for trial in found.trials)


def test_cross_validate__measures_the_angle_of_the_withheld_view_to_the_others():
    config = dataclasses.replace(CONFIG, first_frame_steps=5)
    found, cameras = validate(bytes_of(images_of(opaque_ball())), config=config), views()
    withheld = next(camera for camera in cameras if camera.name == found.withheld[0])
    towards = [camera.position / np.linalg.norm(camera.position) for camera in cameras if camera is not withheld]
    cosines = np.array(towards) @ withheld.position / np.linalg.norm(withheld.position)
    # The ball lies at the origin; its surface, which the angle is measured at, is a little nearer.
    assert found.withheld_angle == pytest.approx(np.rad2deg(np.arccos(cosines.max())), rel=0.1)


def test_cross_validate__is_the_same_every_time():
    images = bytes_of(images_of(opaque_ball()), 0.05)
    config = dataclasses.replace(CONFIG, first_frame_steps=30)
    first, second = (validate(images, config=config, render=RenderConfig(reproducible=True)) for _ in range(2))
    assert first == second


def test_cross_validate__judges_reduced_images_with_their_masks():
    images = bytes_of(images_of(opaque_ball()))
    masks = [np.ones(image.shape[:2], bool) for image in images]
    how = CrossValidationConfig(candidates=(0.0,), width=images[0].shape[1] // 2)
    config = dataclasses.replace(CONFIG, cross_validation=how)
    clean = validate(images, config=config).best
    for image, mask in zip(images, masks, strict=True):
        image[:10], mask[:10] = 255, False
    masked, spoiled = validate(images, masks, config).best, validate(images, config=config).best
    assert masked.withheld_psnr == pytest.approx(clean.withheld_psnr, abs=2)
    assert spoiled.withheld_psnr < masked.withheld_psnr - 2


@pytest.mark.parametrize(
    ("withheld", "training", "poor"), [(33.0, 35.0, False), (15.0, 18.0, True), (24.0, 33.0, True)]
)
def test_sentence__says_what_to_expect(withheld: float, training: float, poor: bool):
    trials = Trial(0.0, withheld - 1, 36.0), Trial(0.2, withheld, training)
    found = CrossValidation(("cam03",), 40.0, 20.0, trials)
    assert f"about {withheld:.0f} dB, estimated from cam03" in found.sentence
    assert ("will be poor" in found.sentence) == poor
    assert ("40 degrees apart" in found.sentence) == poor


def test_expected_psnr__adds_the_excess_of_withheld_views_to_the_error_of_the_first_frame():
    # An excess of 1e-3 - 0.4e-3 at 9 degrees.
    trials = (Trial(0.0, 30.0, 33.9794),)
    assert CrossValidation(("cam03",), 18.0, 9.0, trials).expected_psnr == pytest.approx(30, abs=1e-3)
    found = CrossValidation(("cam03",), 18.0, 9.0, trials, training_psnr=36.9897)
    assert found.expected_psnr == pytest.approx(-10 * np.log10(0.6e-3 + 0.2e-3), abs=1e-3)
    found = CrossValidation(("cam03",), 6.0, 9.0, trials, training_psnr=36.9897)
    assert found.expected_psnr == pytest.approx(-10 * np.log10(0.2e-3 + 0.2e-3), abs=1e-3)
    assert CrossValidation(("cam03",), 0.0, 0.0, trials).expected_psnr > 30


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"min_views": 1}, "`min_views` must be at least 2"),
        ({"candidates": ()}, "rising numbers"),
        ({"candidates": (0.2, 0.0)}, "rising numbers"),
        ({"candidates": (0.0, 1.0)}, "rising numbers"),
        ({"share": 1}, "`share` must be at least 2"),
        ({"steps": 0.0}, "`steps` must be above 0"),
    ],
)
def test_cross_validation_config__names_bad_values(arguments, message):
    with pytest.raises(ValueError, match=message):
        CrossValidationConfig(**arguments)

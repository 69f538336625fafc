"""Cross-validation of the first frame: its blocks, choice and report."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from morgs_mi import RenderConfig
from morgs_mi.core.progress import Progress
from morgs_mi.fit.cross_validation import (
    CrossValidation,
    Trial,
    cross_validate,
    excess_share,
    trial_steps,
    withheld_views,
)
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import View, rendered
from tests.scenes.ball import ball, bytes_of, images_of, opaque_ball, problem, views
from tests.scenes.cameras import arc, look_at_cameras

CONFIG = FitConfig(sh_degree=0, first_frame_steps=100, num_gaussians=150)
VALIDATED = dataclasses.replace(CONFIG, validate=True)


def validate(images, masks=None, config=CONFIG, report=None, render=None):
    return cross_validate(problem(images, masks=masks, render=render), config, 0, Progress(report))


def test_withheld_views__lie_in_the_inner_half_of_the_rig():
    cameras = look_at_cameras(arc(np.linspace(-0.8, 0.8, 13), 4), 40)
    chosen = withheld_views(cameras, 6)
    assert len(chosen) == 2
    assert all(3 <= view <= 9 for view in chosen)
    assert len(withheld_views(cameras[:3], 6)) == 1


@pytest.mark.parametrize(("config", "steps"), [(CONFIG, 15), (VALIDATED, 40)])
def test_cross_validate__makes_one_trial_of_few_views(config: FitConfig, steps: int):
    done = []
    found = validate(bytes_of(images_of(opaque_ball())), config=config, report=lambda *now: done.append(now))
    assert [trial.dropping for trial in found.trials] == [0.0]
    assert done == [("Trial", step, steps) for step in range(1, steps + 1)]


def test_cross_validate__tries_candidates_until_one_is_no_better(monkeypatch):
    monkeypatch.setattr("morgs_mi.fit.cross_validation.MANY_VIEWS", 4)
    done = []
    found = validate(bytes_of(images_of(opaque_ball())), config=VALIDATED, report=lambda *now: done.append(now))
    values = [trial.withheld_psnr for trial in found.trials]
    assert len(values) == 3 or values[-1] <= values[-2]
    assert found.best.withheld_psnr == max(values)
    assert all(trial.training_psnr > trial.withheld_psnr > 15 for trial in found.trials)
    steps = 40
    stages = [f"Trial {number} of 3" for number in range(1, len(found.trials) + 1)]
    assert done == [(stage, step, steps) for stage in stages for step in range(1, steps + 1)]


@pytest.mark.parametrize(
    ("count", "dropping", "validate", "steps"),
    [(4, None, False, 0.15), (4, None, True, 0.4), (2, None, False, 0), (4, 0.1, True, 0)],
)
def test_trial_steps__are_relative_to_the_first_frame(count: int, dropping: float | None, validate: bool, steps: float):
    config = dataclasses.replace(CONFIG, dropping=dropping, validate=validate)
    assert trial_steps(problem(bytes_of(images_of(opaque_ball()))[:count]), config) == steps


@pytest.mark.parametrize(("noise", "dropping"), [(0.0, 0.0), (0.05, 0.2)])
def test_cross_validate__lets_the_noise_choose_the_dropping(noise: float, dropping: float):
    grey = [0.2 + 0.6 * image for image in images_of(opaque_ball())]
    found = validate(bytes_of(grey, noise), config=dataclasses.replace(CONFIG, first_frame_steps=5))
    assert [trial.dropping for trial in found.trials] == [dropping]


def test_cross_validate__withholds_one_of_three_views_of_different_sizes():
    cameras, (start, gaussians) = views()[:3], (ball(80), opaque_ball())
    cameras[1] = cameras[1].resized(cameras[1].width // 2, cameras[1].height // 2)
    given = [View(c, bytes_of([rendered(gaussians, c, RenderConfig())])[0]) for c in cameras]
    found = cross_validate(dataclasses.replace(problem([]), start=start, views=tuple(given)), CONFIG, 0)
    assert len(found.withheld) == 1
    assert found.expected_psnr > 10


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
    clean = validate(images).best
    for image, mask in zip(images, masks, strict=True):
        image[:10], mask[:10] = 255, False
    masked, spoiled = validate(images, masks).best, validate(images).best
    assert masked.withheld_psnr == pytest.approx(clean.withheld_psnr, abs=2)
    assert spoiled.withheld_psnr < masked.withheld_psnr - 2


@pytest.mark.parametrize(
    ("withheld", "training", "spacing", "quality"),
    [
        (33.0, 35.0, 8.0, "good"),
        (33.0, 35.0, 12.0, "fair"),
        (20.0, 23.0, 8.0, "fair"),  # photos with fine texture
        (20.0, 35.0, 56.0, "poor"),  # fog between cameras far apart
        (15.0, 18.0, 8.0, "poor"),
        (24.0, 33.0, 8.0, "poor"),
    ],
)
def test_sentence__follows_from_the_figure_and_the_angle(withheld, training, spacing, quality):
    trials = Trial(0.0, withheld - 1, 36.0), Trial(0.2, withheld, training)
    found = CrossValidation(("cam03",), 8, spacing, 0.5 * spacing, trials)
    assert found.sentence == (
        f"Views between the cameras will be {quality}: about {withheld:.0f} dB, estimated from cam03 in a trial "
        f"without it, {training - withheld:.0f} dB below the training views; the cameras are {spacing:.0f} degrees "
        "apart."
    )


def test_sentence__names_the_uncertainty_of_few_views():
    few = CrossValidation(("cam03",), 4, 8.0, 8.0, (Trial(0.0, 30.0, 33.0),))
    assert "dB, give or take 4 dB, estimated from cam03 in a trial without it" in few.sentence


def test_expected_psnr__adds_the_excess_of_withheld_views_to_the_error_of_the_first_frame():
    # An excess of 1e-3 - 0.4e-3 at 9 degrees.
    trials = (Trial(0.0, 30.0, 33.9794),)
    assert CrossValidation(("cam03",), 8, 18.0, 9.0, trials).expected_psnr == pytest.approx(30, abs=1e-3)
    found = CrossValidation(("cam03",), 8, 18.0, 9.0, trials, training_psnr=36.9897)
    assert found.expected_psnr == pytest.approx(-10 * np.log10(0.6e-3 + 0.2e-3), abs=1e-3)
    found = CrossValidation(("cam03",), 8, 6.0, 9.0, trials, training_psnr=36.9897)
    share = (1 - np.exp(-3 / 20)) / (1 - np.exp(-9 / 20))
    assert found.expected_psnr == pytest.approx(-10 * np.log10(share * 0.6e-3 + 0.2e-3), abs=1e-3)
    assert CrossValidation(("cam03",), 8, 0.0, 0.0, trials).expected_psnr > 29.9


@pytest.mark.parametrize(("trained", "power"), [(2, 3), (3, 2), (6, 1), (12, 1)])
def test_excess_share__grows_by_a_power_of_the_angle_with_few_views(trained: int, power: int):
    assert excess_share(0.4, 0.8, trained) == pytest.approx(0.5**power, rel=0.03)
    assert excess_share(7.0, 7.0, trained) == excess_share(9.0, 7.0, trained) == 1


def test_excess_share__ends_where_neighbours_show_something_else():
    assert excess_share(40.0, 80.0, 2) > 0.99
    assert excess_share(40.0, 80.0, 7) > 0.85

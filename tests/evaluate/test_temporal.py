"""Quality over time: variation of static pixels, recorded change, slope of a score."""

import numpy as np
import pytest

from morgs_mi.evaluate.metrics import StillVariation, recorded_change, slope

rng = np.random.default_rng(0)
SIZE = (24, 32)
GREY = np.full((*SIZE, 3), 0.5)
NOTHING = np.zeros(SIZE, bool)


def test_still_variation__is_the_mean_change_of_pixels_that_never_move():
    left_half = NOTHING.copy()
    left_half[:, :8] = True
    variation = StillVariation()
    for step, moving in ((0.0, NOTHING), (0.01, left_half), (-0.02, NOTHING)):
        image = GREY + step
        image[:, :8] += 10 * step  # pixels that moved once are not counted
        variation.add(image, GREY + step / 2, moving)
    result = variation.result()
    assert result.render == pytest.approx(100 * (0.01 + 0.03) / 2)
    assert result.input == pytest.approx(100 * (0.01 + 0.03) / 4)
    assert result.still_share == pytest.approx(24 / 32)


def test_still_variation__tolerates_false_alarms():
    once = NOTHING.copy()
    twice = NOTHING.copy()
    once[:, :8] = True
    twice[:, :4] = True
    variation = StillVariation(false_alarms=0.1)
    for moving in (once, twice, *[NOTHING] * 8):
        variation.add(GREY, GREY, moving)
    assert variation.result().still_share == pytest.approx(28 / 32), "one frame in ten"


def test_still_variation__of_too_few_frames_or_pixels_is_nan():
    variation = StillVariation(valid=NOTHING)
    variation.add(GREY, GREY, NOTHING)
    assert np.isnan(variation.result().render)
    variation.add(GREY, GREY, NOTHING)
    assert np.isnan(variation.result().input), "no pixel is valid"


def test_recorded_change__is_distinguished_from_noise():
    scene = rng.random((*SIZE, 3))
    image, next_image = (scene + rng.normal(0, 0.02, scene.shape) for _ in range(2))
    # Four deviations are exceeded by 6 in 100,000 pixels.
    assert recorded_change(image, next_image).mean() < 0.01
    next_image[4:14, 6:18] += 0.3
    changed = recorded_change(image, next_image)
    assert changed[5:13, 7:17].all()
    assert not changed[18:].any()


def test_recorded_change__is_empty_for_equal_images_and_for_a_global_flicker():
    assert not recorded_change(GREY, GREY).any()
    assert not recorded_change(GREY, GREY + 0.1).any()


def test_slope__is_that_of_a_line():
    assert slope([30, 29.5, 29, 28.5]) == pytest.approx(-0.5)
    assert slope([30, np.nan, 29]) == pytest.approx(-0.5), "time goes on where a score is missing"
    noisy = 30 + 0.1 * np.arange(50) + rng.normal(0, 1, 50)
    assert slope(noisy) == pytest.approx(np.polyfit(np.arange(50), noisy, 1)[0])
    assert np.isnan([slope([]), slope([3]), slope([np.inf, 3]), slope([np.nan, 3])]).all()

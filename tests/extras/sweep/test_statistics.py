"""Statistics of a sweep: noise does not decide, losses do, and seconds are interpolated."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.extras.sweep.statistics import (
    DECIDING,
    INDEX,
    SCORES,
    excess,
    level_lines,
    mean_of,
    round_levels,
)

PARTS = 12
# Scores of a fit with all parts.
BASE = np.array([100, 8, 30, 25, 0.9, 0.1, 0.5, 200])


def scores_with_noise(rng, seeds, parts=PARTS, seconds=0.3, first=0.5, psnr=0.01):
    """Return the scores of the method and of parts without any effect [1 + parts, seeds, N].

    Args:
        rng: random numbers.
        seeds: number of seeds.
        parts: number of parts.
        seconds: standard deviation of the logarithm of the seconds.
        first: standard deviation of the PSNR of a first frame, which all fits of a seed share, dB.
        psnr: standard deviation of the PSNR of a fit, dB.
    """
    scores = np.tile(BASE, (1 + parts, seeds, 1))
    scores[..., INDEX["seconds"]] *= np.exp(seconds * rng.normal(size=(1 + parts, seeds)))
    for name in ("psnr", "psnr_moving"):
        scores[..., INDEX[name]] += first * rng.normal(size=(1, seeds))
        scores[..., INDEX[name]] += psnr * rng.normal(size=(1 + parts, seeds))
    return scores


def reasons(scores, calls=0):
    """Return the names of the scores that decide, for each part."""
    reference = np.zeros(len(scores), int)
    ratios = excess(scores, reference, np.broadcast_to(calls, scores.shape[:2]), 0.05)
    assert np.nan_to_num(ratios[0]).tolist() == [0] * len(DECIDING)
    return [[DECIDING[k] for k in np.flatnonzero(row > 1)] for row in ratios[1:]]


@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.3])
@pytest.mark.parametrize("seeds", [1, 2, 3, 5])
def test_excess__at_most_5_percent_of_parts_without_effect_are_needed(seeds, seconds):
    rng = np.random.default_rng(seeds)
    rows = [reasons(scores_with_noise(rng, seeds, seconds=seconds)) for _ in range(150)]
    assert np.mean([bool(names) for row in rows for names in row]) <= 0.05


@pytest.mark.parametrize("seeds", [2, 3])
@pytest.mark.parametrize(
    ("name", "loss"),
    [
        ("psnr", -0.2),
        ("psnr_moving", -0.2),
        ("motion_error_moving", 0.05),
        ("kilobytes", 20),
        ("seconds", 20),
    ],
)
def test_excess__a_loss_is_found_and_named(name, loss, seeds):
    rng = np.random.default_rng(0)
    names = []
    for _ in range(50):
        scores = scores_with_noise(rng, seeds)
        scores[3, :, INDEX[name]] += loss
        names += [name in reasons(scores)[2]]
    assert np.mean(names) >= 0.9


@pytest.mark.parametrize(
    ("name", "change"),
    [("psnr", -0.04), ("psnr", 3), ("kilobytes", 9), ("kilobytes", -90), ("seconds", 0.3)],
)
def test_excess__gains_and_small_losses_do_not_decide(name, change):
    scores = scores_with_noise(np.random.default_rng(0), 3, seconds=0, psnr=0)
    scores[1:, :, INDEX[name]] += change
    assert reasons(scores) == [[]] * PARTS


def test_excess__pairs_of_one_first_frame_are_compared():
    scores = scores_with_noise(np.random.default_rng(0), 3, first=5, psnr=0)
    scores[1, :, INDEX["psnr"]] -= 0.1
    assert reasons(scores)[0] == ["psnr"]


def test_excess__one_slow_fit_does_not_decide():
    scores = scores_with_noise(np.random.default_rng(0), 3, seconds=0.02)
    scores[1, 1, INDEX["seconds"]] *= 5
    assert reasons(scores)[0] == []


def test_excess__seconds_need_fits_that_ran_in_turn():
    scores = scores_with_noise(np.random.default_rng(0), 3, seconds=0.02)
    scores[1:3, :, INDEX["seconds"]] *= 2
    calls = np.zeros(scores.shape[:2])
    calls[1] = 1
    assert reasons(scores, calls)[:2] == [[], ["seconds"]]


def test_excess__one_seed_leaves_the_tolerance():
    scores = scores_with_noise(np.random.default_rng(0), 1, psnr=0)
    scores[1, :, INDEX["psnr"]] -= 0.06
    scores[2, :, INDEX["psnr"]] -= 0.04
    scores[3, :, INDEX["seconds"]] *= 10
    assert reasons(scores)[:3] == [["psnr"], [], []]


def test_excess__unknown_scores_do_not_decide():
    scores = scores_with_noise(np.random.default_rng(0), 2)
    scores[..., INDEX["motion_error_moving"]] = np.nan
    scores[4:] = np.nan
    scores[1, 1, INDEX["psnr"]] = np.inf
    assert reasons(scores)[3:] == [[]] * (PARTS - 3)


def test_mean_of__is_of_the_seeds_that_are_known():
    values = np.array([[1.0, 3.0, np.nan], [2.0, np.nan, np.nan], [np.nan] * 3])[..., None]
    means = mean_of(values)
    assert_allclose(means.mean[:, 0], [2, 2, np.nan])
    assert_allclose(means.error[:, 0], [1, np.nan, np.nan])


@pytest.mark.parametrize(
    ("values", "levels"),
    [
        ([36.1, 37.9], [36.5, 37, 37.5]),
        ([28, 41], [30, 35, 40]),
        ([0.931, 0.952], [0.94, 0.95]),
        ([3, 3], []),
        ([], []),
    ],
)
def test_round_levels__lie_between_the_values(values, levels):
    assert_allclose(round_levels(np.array(values, float)), levels)


def test_level_lines__interpolate_in_the_logarithm_of_the_seconds():
    curves = {
        "baseline": np.array([[1.0, 4.0, 16.0], [33.0, 35.0, 35.5]]),
        "default": np.array([[2.0, 8.0], [34.5, 37.5]]),
    }
    assert level_lines("later frame", curves, SCORES["psnr"]) == [
        "later frame, 34 dB: baseline 2 s, default at most 2 s",
        "later frame, 36 dB: baseline not reached, default 4 s",
    ]
    errors = {"default": np.array([[1.0, 4.0], [3.0, 1.0]])}
    score = SCORES["motion_error_moving"]
    assert level_lines("later frame", errors, score)[1] == "later frame, 1.5 px: default 2.83 s"

"""Exposures in closed form: gains and biases, outliers, priors, and what all cameras have in
common.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.method.exposure import (
    LEAST_CHANGE,
    Exposure,
    centred,
    common_change,
    fit_exposure,
    follow_exposure,
)

WARM = Exposure((1.1, 1.0, 0.9), (0.02, 0.0, -0.01))


def scene(seed=0, size=(60, 80)):
    return np.random.default_rng(seed).uniform(0.1, 0.8, (*size, 3))


def as_bytes(colors):
    return np.rint(255 * colors.clip(0, 1)).astype(np.uint8)


def assert_close(value, expected, atol):
    assert_allclose((value.gain, value.bias), (expected.gain, expected.bias), atol=atol)


def test_fit_exposure__finds_gain_and_bias_of_each_channel():
    assert_close(fit_exposure(scene(), WARM(scene()), weights=(0, 0)), WARM, 1e-9)


def test_fit_exposure__is_not_drawn_by_a_third_of_moved_pixels():
    recorded = WARM(scene())
    recorded[:20] = scene(1)[:20]
    assert_close(fit_exposure(scene(), recorded, weights=(0, 0)), WARM, 2e-3)


def test_fit_exposure__is_the_prior_without_well_exposed_pixels():
    assert fit_exposure(np.ones((40, 40, 3)), scene(size=(40, 40)), prior=WARM) == WARM


def test_fit_exposure__is_the_prior_of_images_that_do_not_show_the_same():
    assert fit_exposure(scene(), 0.9 - scene(), prior=WARM) == WARM


def test_fit_exposure__explains_a_change_by_a_factor_on_the_light_where_images_have_no_contrast():
    dull = encode_light(np.random.default_rng(0).uniform(0.2, 0.21, (40, 40, 3)))
    exposure = fit_exposure(dull, encode_light(1.1 * decode_light(dull)))
    assert_allclose(exposure(scene()), encode_light(1.1 * decode_light(scene())), atol=0.003)


def test_fit_exposure__ignores_masked_pixels():
    recorded = WARM(scene())
    mask = np.ones((60, 80), bool)
    recorded[:45] = 0.5
    mask[:45] = False
    assert_close(fit_exposure(scene(), recorded, mask, weights=(0, 0)), WARM, 1e-9)


def test_exposure__corrects_to_the_colours_of_the_scene():
    image = as_bytes(scene())
    shown = as_bytes(WARM(image / 255))
    assert np.abs(WARM.corrected(shown).astype(int) - image).max() <= 1
    assert Exposure().corrected(image) is image


def test_exposure__composes():
    first = Exposure((1.2, 1, 1), (0.1, 0, 0))
    second = Exposure((0.5, 2, 1), (0, 0, 0.3))
    assert_allclose(second.after(first)(scene()), second(first(scene())))
    assert_allclose(second.after(first).without(first)(scene()), second(scene()))


def test_centred__leaves_differences_between_cameras():
    truth = (WARM, Exposure((1.3, 1.2, 1.1), (0.1, 0.1, 0.0)))
    exposures = centred(truth)
    middle = np.full(3, 0.4)
    assert_allclose(np.mean([e(middle) for e in exposures], axis=0), middle, atol=0.01)
    # The map from one camera's image to another's is the same.
    colors = scene()
    assert_allclose(exposures[1].without(exposures[0])(colors), truth[1].without(truth[0])(colors))


def test_centred__is_not_moved_by_a_few_dark_cameras():
    dark = Exposure((0.7,) * 3, (-0.02,) * 3)
    result = centred([dark if view < 3 else Exposure() for view in range(9)])
    assert_close(result[8], Exposure(), 1e-12)
    assert_close(result[0], dark, 1e-12)


def test_common_change__is_that_of_most_cameras():
    dimmed = Exposure((0.8,) * 3, (0.0,) * 3)
    assert_close(
        common_change([dimmed, dimmed, Exposure((0.81,) * 3), WARM]), Exposure((0.805,) * 3), 0.01
    )


def test_common_change__is_none_where_cameras_differ():
    gains = (0.9, 0.95, 1.02, 1.1)
    assert common_change([Exposure((gain,) * 3) for gain in gains]) == Exposure()


def test_common_change__needs_three_cameras():
    assert common_change([WARM, WARM]) == Exposure()


@pytest.mark.parametrize("noise", [0, 2])
def test_follow_exposure__is_none_without_a_change(noise):
    rng = np.random.default_rng(2)
    image = as_bytes(scene(size=(120, 160)))
    noisy = np.clip(image + rng.normal(0, noise, image.shape).round(), 0, 255).astype(np.uint8)
    noisy[:30] = 90  # something moved
    assert follow_exposure(image, noisy).change < LEAST_CHANGE


def test_follow_exposure__finds_a_change_of_two_percent():
    image = as_bytes(scene(size=(120, 160)))
    change = Exposure((1.02, 0.98, 1.0), (0.0011, -0.0011, 0))
    assert_close(follow_exposure(image, as_bytes(change(image / 255))), change, 2e-3)


def test_corrected__factor_on_the_light_is_removed_also_above_white():
    light = np.geomspace(0.01, 100, 30, dtype=np.float32).reshape(2, 5, 3)
    gain = 1.3 ** (1 / 2.4)
    exposure = Exposure((gain,) * 3, (0.055 * (gain - 1),) * 3)
    corrected = exposure.corrected(encode_light(1.3 * light).astype(np.float32))
    assert corrected.dtype == np.float32
    assert_allclose(corrected, encode_light(light), rtol=1e-5)

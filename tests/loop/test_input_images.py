"""The images that a caller may push, and what the loop makes of them."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.core import color_space
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import display_image, encode_light
from morgs_mi.core.view import View
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.loop.input_images import copied_images
from morgs_mi.loop.observation import ImageHistory, observe_frame, prepare
from morgs_mi.loop.stream_config import StreamConfig

CAMERA = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 50, 6, 5, "cam")
LIGHT = np.random.default_rng(0).uniform(0, 4, (5, 6, 3)).astype(np.float32)
GREY = np.random.default_rng(0).integers(0, 256, (5, 6, 3), np.uint8)


def copied(image):
    return copied_images([View(CAMERA)], [image], 0)[0]


@pytest.mark.parametrize(
    "image",
    [
        LIGHT.astype(np.float64),
        lambda: mi.TensorXf(LIGHT),
        lambda: mi.Bitmap(LIGHT),
        lambda: mi.Bitmap(np.concatenate([LIGHT, np.ones((5, 6, 1), np.float32)], axis=2)),
    ],
    ids=["float64", "tensor", "bitmap", "rgba"],
)
def test_copied_images__linear_light_stays_as_it_is(image):
    assert_array_equal(copied(image() if callable(image) else image), LIGHT)


def test_copied_images__light_without_a_fraction_is_no_integer_of_16_bits():
    light = np.full_like(LIGHT, 9e29)  # float32 has no fractions there
    assert_array_equal(copied(light), light)


def test_copied_images__flag_of_a_bitmap_counts():
    assert_array_equal(copied(mi.Bitmap(GREY)), GREY)
    linear = mi.Bitmap(GREY)
    linear.set_srgb_gamma(False)
    assert_allclose(copied(linear), GREY / 255, atol=1e-6)


def test_copied_images__refuses_a_bitmap_of_many_channels():
    with pytest.raises(ValueError, match=r"must be grey or have colours, got 6 channels"):
        copied(mi.Bitmap(np.ones((5, 6, 6), np.float32)))


def test_copied_images__owns_its_memory():
    for image in (LIGHT.copy(), GREY.copy()):
        result = copied(image)
        expected = result.copy()
        image[:] = 0
        assert_array_equal(result, expected)


def test_copied_images__warns_once_of_negative_light(caplog):
    color_space._warn_about_negative_light.cache_clear()
    for _ in range(2):
        assert copied(LIGHT - 1).min() == 0
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (
            LIGHT[:4],
            r"must be uint8 \[5, 6, 3\], or linear light in floats, got float32 \[4, 6, 3\]; "
            r"convert it",
        ),
        (LIGHT + np.inf, "must be finite and at most 1e"),
        (GREY.astype(int), r"got int64 \[5, 6, 3\]"),
    ],
)
def test_copied_images__refuses_others(image, message):
    with pytest.raises(ValueError, match=rf"push\(\): frame 0 of view 'cam' .*{message}"):
        copied(image)


RIG = [View(replace(CAMERA, name=name)) for name in "ab"]


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (2 * [np.float32(GREY)], "linear light with 1 for white .*, got values up to .*by 255"),
        ([GREY, LIGHT], "must be uint8 .* for all views, or floats .*, got float32 and uint8"),
        ({"c": GREY}, r"got a dict with \['c'\]; name one camera each of \['a', 'b'\]"),
    ],
)
def test_copied_images__refuses_frames(images, message):
    with pytest.raises(ValueError, match=rf"^push\(\): .*{message}"):
        copied_images(RIG, images, 0)


def test_observe_frame__refuses_other_numbers_than_the_frame_before():
    history = observed([LIGHT]).history
    with pytest.raises(ValueError, match="like the frames before it, got float32 and uint8"):
        observed([GREY], history)


def observed(images, history=None, **kwargs):
    config = StreamConfig(fit=FitConfig(num_gaussians=100))
    setup = prepare([CAMERA], np.zeros((0, 3)), np.zeros((0, 3)), config, **kwargs)
    return observe_frame(setup, 0, history or ImageHistory(), images)


def test_observe_frame__keeps_light_for_the_fit_and_shows_8_bits():
    result = observed([LIGHT], display_exposure=-1.0)
    view = result.views[0]
    assert_array_equal(view.encoded, encode_light(LIGHT))
    assert view.encoded.dtype == np.float32
    assert_array_equal(view.image, display_image(LIGHT, -1))


def test_observe_frame__first_frame_determines_the_display_exposure():
    first = observed([LIGHT])
    white = np.percentile(LIGHT.max(axis=-1), 99)
    assert first.history.display_exposure == pytest.approx(-np.log2(white))
    observation = observed([100 * LIGHT], first.history)
    assert observation.history.display_exposure == first.history.display_exposure


def test_observe_frame__bytes_are_compared_and_shown_alike():
    result = observed([GREY])
    view = result.views[0]
    assert view.encoded is view.image
    assert_array_equal(view.encoded, GREY)

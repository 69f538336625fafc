"""Images between two frames of a clip."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.capture.interpolation import Between
from morgs_mi.evaluate.metrics import psnr

HEIGHT = 72
WIDTH = 96


def texture():
    """Return a smooth random image [2H, 2W, 3]."""
    noise = np.random.default_rng(0).uniform(0, 255, (2 * HEIGHT, 2 * WIDTH, 3))
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)


def moving_square(position):
    """Return a textured square at some column before a static background, uint8."""
    layer = np.zeros((HEIGHT, WIDTH, 4))
    layer[20:52, 30:62, :3] = texture()[20:52, 30:62]
    layer[20:52, 30:62, 3] = 1
    shift = np.float32([[1, 0, position], [0, 1, 0]])
    layer = cv2.warpAffine(layer, shift, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    opaque = layer[..., 3:].clip(0, 1)
    background = texture()[HEIGHT:, WIDTH:]
    return np.clip(background * (1 - opaque) + layer[..., :3] * opaque, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
def test_between__shows_things_where_they_have_moved_to(share):
    first = moving_square(0)
    second = moving_square(4)
    expected = moving_square(4 * share)
    image = Between(first, second).at(share)
    blended = (1 - share) * first + share * second
    assert image.dtype == np.uint8
    for window, gain in (((slice(24, 48), slice(38, 58)), 10), (slice(None), 2)):
        score, blended_score = (
            psnr(each[window] / 255, expected[window] / 255) for each in (image, blended)
        )
        assert score > blended_score + gain


@pytest.mark.parametrize("share", [0, 1])
def test_between__is_a_frame_at_either_end(share):
    frames = moving_square(0), moving_square(4)
    assert_allclose(Between(*frames).at(share).astype(int), frames[share], atol=1)

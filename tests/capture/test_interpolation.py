"""Images between two frames of a clip."""

from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.capture.interpolation import FrameInterpolation
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES

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
def test_frame_interpolation__shows_things_where_they_have_moved_to(share):
    first = moving_square(0)
    second = moving_square(4)
    expected = moving_square(4 * share)
    image = FrameInterpolation(first, second).at(share)
    blended = (1 - share) * first + share * second
    assert image.dtype == np.uint8
    for window, gain in (((slice(24, 48), slice(38, 58)), 10), (slice(None), 2)):
        score, blended_score = (
            psnr(each[window] / 255, expected[window] / 255) for each in (image, blended)
        )
        assert score > blended_score + gain


@pytest.mark.parametrize("share", [0, 1e-6, 1 - 1e-6, 1])
def test_frame_interpolation__is_a_frame_at_either_end(share):
    frames = moving_square(0), moving_square(4)
    image = FrameInterpolation(*frames).at(share)
    assert_allclose(image.astype(int), frames[round(share)], atol=1)


def test_frame_interpolation__computes_the_flow_once_and_at_the_ends_never(monkeypatch):
    make = Mock(wraps=FLOW_SOURCES.make)
    monkeypatch.setattr(FLOW_SOURCES, "make", make)
    frames = FrameInterpolation(moving_square(0), moving_square(4))
    for share, flows in ((0, 0), (1, 0), (0.3, 1), (0.6, 1)):
        frames.at(share)
        assert make.call_count == flows

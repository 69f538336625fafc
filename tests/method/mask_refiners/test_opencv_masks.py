"""GrabCut: objects from partial masks, any mask and size, repeatable results."""

import numpy as np
import pytest

from morgs_mi.evaluate.metrics import iou
from morgs_mi.method.mask_refiners.opencv_masks import clean_mask, refine_mask
from tests.method.moving_disc import moving_disc

CAMERA_NOISE = 2 / 255  # standard deviation of a video camera in room light


def test_refine_mask__recovers_an_object_from_a_part_of_it():
    _, image, disc = moving_disc(240, 320, (3, 0), CAMERA_NOISE)
    partial = disc.copy()
    partial[120:140] = False
    assert iou(refine_mask(image, partial), disc) > 0.95 > iou(partial, disc)


@pytest.mark.parametrize("size", [(1, 1), (700, 20)])
def test_refine_mask__accepts_any_mask(size):
    image = np.random.default_rng(0).random((*size, 3))
    assert not refine_mask(image, np.zeros(size, bool)).any()
    assert refine_mask(image, np.ones(size, bool)).all()
    half = refine_mask(image, np.arange(size[0] * size[1]).reshape(size) % 2 == 0)
    assert (half.shape, half.dtype) == (size, bool)


def test_clean_mask__removes_specks_and_closes_holes():
    mask = np.zeros((200, 400), bool)
    mask[50:150, 50:150] = True
    mask[100:102, 100:102] = False
    mask[10:12, 300:302] = True
    cleaned = clean_mask(mask)
    assert cleaned[52:148, 52:148].all()
    assert not cleaned[:, 250:].any()

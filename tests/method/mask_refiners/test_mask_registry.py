"""Mask refiners by name, and the page that describes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS
from tests.method.moving_disc import moving_disc

ROOT = Path(__file__).parents[3]
CAMERA_NOISE = 2 / 255  # standard deviation of a video camera in room light


@pytest.mark.parametrize("method", ["none", "grabcut", "superpixels+grabcut"])
def test_mask_refiner__is_repeatable(method):
    _, image, disc = moving_disc(120, 160, (3, 2), CAMERA_NOISE)
    refine = MASK_REFINERS.make(method)
    np.testing.assert_array_equal(refine(image, disc), refine(image, disc))
    np.testing.assert_array_equal(
        refine((image * 255 + 0.5).astype(np.uint8), disc), refine(image, disc)
    )


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("sam", r"one of none, grabcut, .*DECODER.onnx, got 'sam'"),
        ("sam2:encoder.onnx", r"got 'sam2:encoder.onnx'"),
    ],
)
def test_mask_refiner__rejects_unknown_methods(method, message):
    with pytest.raises(ValueError, match=message):
        MASK_REFINERS.make(method)


def test_masks_page__lists_every_refiner():
    text = (ROOT / "docs/masks.md").read_text(encoding="utf-8")
    assert [usage for usage in MASK_REFINERS.usages if f"- `{usage}`: " not in text] == []

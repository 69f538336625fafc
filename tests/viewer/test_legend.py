"""Legends of the modes."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

from morgs_mi.playback.visualise import confidence_image, depth_image
from morgs_mi.viewer.legend import legend_html
from morgs_mi.viewer.modes import MODES
from tests.assertions import assert_close

DEPTHS = np.r_[np.linspace(2, 8, 101), np.nan, -1][:, None]


def bar(html: str) -> np.ndarray:
    """Return the image of a legend."""
    data = re.findall('base64,([^"]+)', html)[0]
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@pytest.mark.parametrize(
    ("mode", "texts"),
    [
        ("motion", ("direction on the screen", "12 px per frame", "no motion")),
        ("offset", ("direction on the screen", "1.2 px per frame", "no offset")),
        ("confidence", ("0 static", "1 moving")),
        ("depth", ("2.06 near", "7.94 far", "world units")),
        ("wetness", (">0<", ">1<")),
    ],
)
def test_legend_html__has_values_and_units(mode, texts):
    html = legend_html(mode, DEPTHS, 12.0)
    assert all(text in html for text in texts), html


def test_legend_html__every_mode_but_colour_has_one():
    assert [mode for mode in MODES if not legend_html(mode, DEPTHS, 12.0)] == ["color"]


def test_legend_html__colours_are_those_of_the_images():
    ends = confidence_image(np.array([[0.0, 1.0]]))
    assert_close(bar(legend_html("confidence", DEPTHS, 12.0))[0, [0, -1]].astype(int), ends[0], atol=0)
    depths = DEPTHS[:101]
    low, high = np.percentile(depths, (1, 99))
    ends = depth_image(np.array([[low, 2 / (1 / low + 1 / high), high]]), low, high)
    colors = bar(legend_html("depth", depths, 12.0))[0, [0, 128, -1]]
    assert_close(colors.astype(int), ends[0], atol=8)

"""FLIP compared with its authors' program, dE2000 with known differences."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.evaluate import perception
from morgs_mi.evaluate.perception import delta_e_map, flip_map
from tests.assertions import assert_close

ROWS, COLUMNS = np.mgrid[:48, :64]
TRUTH = np.stack([0.5 + 0.4 * np.sin(COLUMNS / 5 + k) * np.cos(ROWS / 7 - k) for k in range(3)], -1)
IMAGE = np.stack([0.5 + 0.4 * np.sin(COLUMNS / 5.2 + k + 0.1) * np.cos(ROWS / 7 - k) for k in range(3)], -1)
BLACK = np.zeros((20, 20, 3))
GREEN, BLUE = BLACK + np.eye(3)[1], BLACK + np.eye(3)[2]


@pytest.mark.parametrize(
    ("image", "truth", "pixels_per_degree", "expected"),
    [
        (IMAGE, TRUTH, perception.PIXELS_PER_DEGREE, 0.2144013),
        (IMAGE, TRUTH, 20.0, 0.2094097),
        (BLACK, BLACK + 1, perception.PIXELS_PER_DEGREE, 0.9673862),
        (GREEN, BLUE, perception.PIXELS_PER_DEGREE, 1.0),
    ],
    ids=["waves", "waves from afar", "black and white", "the ends of the gamut"],
)
def test_flip_map__agrees_with_its_authors_program(image, truth, pixels_per_degree, expected):
    """Expected are means of the authors' package flip-evaluator 1.7, which works in single precision."""
    assert flip_map(image, truth, pixels_per_degree).mean() == pytest.approx(expected, abs=1e-5)


def test_flip_map__is_bounded_and_symmetric():
    error = flip_map(IMAGE, TRUTH)
    assert (flip_map(TRUTH, TRUTH) == 0).all()
    # Sums of the same terms in another order.
    assert_close(error, flip_map(TRUTH, IMAGE), atol=1e-12)
    noise = np.random.default_rng(0).integers(0, 2, (2, 40, 40, 3)).astype(float)
    assert 0 <= error.min() < error.max() <= 1
    assert flip_map(*noise).max() <= 1


def test_flip_map__lies_where_the_error_is():
    image = TRUTH.copy()
    image[20:24, 30:34] += 0.2
    error = flip_map(image, TRUTH)
    assert 20 <= error.argmax() // 64 < 24
    # Beyond the reach of the eye's and of the edge filter, 10 and 9 pixels.
    assert (error[:, :20] == 0).all()
    assert (error[:10] == 0).all()


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((255, 0, 0), (0, 0, 255), 52.88),
        ((255, 0, 0), (0, 255, 0), 86.61),
        ((0, 0, 0), (255, 255, 255), 100),
        ((9, 99, 199), (9, 99, 199), 0),
    ],
)
def test_delta_e_map__of_the_corners_of_the_gamut(a, b, expected):
    """Values that calculators of CIE dE2000 agree on for sRGB, to their two digits."""
    found = delta_e_map(np.full((1, 1, 3), a, np.uint8), np.full((1, 1, 3), b, np.uint8))
    assert found == pytest.approx(expected, abs=0.005)


def test_delta_e_map__is_per_pixel():
    image = TRUTH.copy()
    image[37, 5] = 1 - image[37, 5]
    error = delta_e_map(image, TRUTH)
    assert error.shape == (48, 64)
    assert np.argwhere(error).tolist() == [[37, 5]]


@pytest.mark.parametrize("metric", [flip_map, delta_e_map])
def test_flip_map_and_delta_e_map__bytes_and_floats_agree(metric):
    a, b = ((x * 255 + 0.5).astype(np.uint8) for x in (IMAGE, TRUTH))
    np.testing.assert_allclose(metric(a, b), metric(a / 255, b / 255))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: flip_map(TRUTH, TRUTH[:5]), r"flip_map\(\): .* \(5, 64, 3\)"),
        (lambda: flip_map(TRUTH[..., 0], TRUTH[..., 0]), r"must be \[H, W, 3\], got \(48, 64\)"),
        (lambda: flip_map(TRUTH, TRUTH, 0), "`pixels_per_degree` must be positive, got 0"),
        (lambda: delta_e_map(TRUTH, TRUTH[:5]), r"delta_e_map\(\): .* \(5, 64, 3\)"),
        (lambda: delta_e_map(TRUTH[..., :2], TRUTH[..., :2]), r"must be \[H, W, 3\]"),
    ],
)
def test_flip_map_and_delta_e_map__refuse_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()

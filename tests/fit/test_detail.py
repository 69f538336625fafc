"""The number of Gaussians from the detail of images."""

import numpy as np
import pytest

from morgs_mi.core.rig import mean_views
from morgs_mi.core.view import View
from morgs_mi.fit import budget
from morgs_mi.fit.budget import plan_first_frame
from morgs_mi.fit.detail import count_details
from morgs_mi.fit.fit_config import FitConfig
from tests.scenes.cameras import look_at_cameras

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))


def texture(width=64, height=48, cell=4, amplitude=80, noise=0):
    """Return cells of random brightness with noise; both in 8-bit units."""
    rng = np.random.default_rng(1)
    cells = rng.uniform(-amplitude, amplitude, (height // cell, width // cell, 1))
    image = (
        128
        + cells.repeat(cell, axis=0).repeat(cell, axis=1)
        + rng.normal(0, noise, (height, width, 3))
    )
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def test_count_details__has_none_in_flat_or_noisy_images():
    assert count_details(texture(amplitude=0), None) == 0
    assert count_details(texture(amplitude=0, noise=6), None) < 30


def test_count_details__counts_the_cells_of_a_texture():
    cells = (64 // 4) * (48 // 4)
    for image in (texture(), texture(noise=6)):
        assert 0.7 * cells < count_details(image, None) < 1.1 * cells
    assert count_details(texture(cell=2), None) > 2 * count_details(texture(), None)


def test_count_details__counts_valid_pixels_only():
    image = texture()
    mask = np.zeros((48, 64), bool)
    assert count_details(image, mask) == 0
    mask[:, :32] = True
    assert count_details(image, mask) == pytest.approx(count_details(image, None) / 2, rel=0.1)


@pytest.fixture(autouse=True)
def wide_limits(monkeypatch):
    monkeypatch.setattr(budget, "PER_DETAIL", 1.0)
    monkeypatch.setattr(budget, "LEAST_GAUSSIANS", 10)


def count(cameras, image, points):
    """Return the number of Gaussians of views that all show one image."""
    fit_config = FitConfig(first_frame_seconds=1e9)
    views = [View(camera, image) for camera in cameras]
    return plan_first_frame(views, points, fit_config)[0].num_gaussians


def test_plan_first_frame__counts_what_several_views_see_once():
    (camera,) = look_at_cameras([(0, 0, -4)], 40)
    image = texture()
    one = count([camera], image, POINTS)
    assert count([camera] * 3, image, POINTS) == pytest.approx(one, abs=1)
    beside = [c for x in (0, 9) for c in look_at_cameras([(x, 0, -4)], 40, target=(x, 0, 0))]
    points = np.concatenate([POINTS, POINTS + np.array([9, 0, 0])])
    assert mean_views(beside, points) == 1
    assert count(beside, image, points) == 2 * one

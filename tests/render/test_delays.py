"""Views at a time of their own: delays and rolling shutters displace what moves."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import rasterize
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.scenes.cameras import make_camera
from tests.scenes.derivatives import assert_backward_agrees_with_differences
from tests.scenes.gaussians import make_scene, to_gaussians


@pytest.fixture(scope="module")
def moving():
    """Gaussians that move by up to a few pixels in a frame, a learned offset included; and a
    camera.
    """
    raw = make_scene()
    raw["offset"] = 0.05 * np.random.default_rng(5).normal(size=raw["means"].shape)
    return raw, make_camera()


def test_rasterize__shows_each_gaussian_at_the_time_of_its_row(moving):
    raw, camera = moving
    rows = camera.project(raw["means"])[0][:, 1] / camera.height
    delays = 0.1 - 0.5 * (np.clip(rows, 0, 1) - 0.5)[:, None]
    expected = rasterize(
        to_gaussians({**raw, "means": raw["means"] + delays * raw["motion"]}), camera, ("color",)
    )
    image = rasterize(to_gaussians(raw), replace(camera, delay=0.1, readout=-0.5), ("color",))
    assert_close(image.color, np.asarray(expected.color), atol=tol.IMAGE_ABS)
    without = replace(to_gaussians(raw), motion=None, offset=None)
    still = rasterize(without, replace(camera, delay=0.4), ("color",)).color
    assert np.array_equal(still, rasterize(without, camera, ("color",)).color)


def test_rasterize__backward_agrees_with_central_differences_after_a_delay(moving):
    raw, camera = moving
    delayed = replace(camera, delay=-0.3, readout=0.6)
    assert_backward_agrees_with_differences(raw, delayed, ("means", "motion"))


def test_rasterize__draws_the_guided_part_of_the_motion(moving):
    raw, camera = moving
    guided = to_gaussians({**raw, "motion": raw["motion"] - raw["offset"]})
    image = rasterize(to_gaussians(raw), camera, ("motion", "guided_motion"))
    assert_close(
        image["guided_motion"], np.asarray(rasterize(guided, camera, ("motion",)).motion), atol=1e-5
    )
    assert_close(
        image.motion,
        np.asarray(rasterize(replace(guided, motion=raw["motion"]), camera, ("motion",)).motion),
    )
    alone = replace(to_gaussians(raw), offset=None)
    image = rasterize(alone, camera, ("motion", "guided_motion"))
    assert np.array_equal(image["guided_motion"], image.motion)

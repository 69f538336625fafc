"""The Gaussian in a pixel, by the renderer's weights."""

from __future__ import annotations

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize
from morgs_mi.viewer.picking import blend_weights, description
from tests.assertions import assert_close
from tests.scenes.changing_splats import rig, splats, write_stream

CONFIG = RenderConfig()


def test_blend_weights__reproduce_the_pixel():
    gaussians, camera = splats(), rig()[1]
    image = rasterize(gaussians, camera, ("alpha",), features=np.arange(40.0)[:, None], config=CONFIG)
    for column, row in ((30, 25), (20, 30), (63, 47), (0, 0)):
        weights = blend_weights(gaussians, camera, column, row, CONFIG)
        assert_close(weights.sum(), np.array(image.alpha)[row, column, 0], atol=1e-5)
        assert_close(weights @ np.arange(40.0), np.array(image.features)[row, column, 0], rtol=1e-4, atol=1e-4)


def test_blend_weights__are_largest_for_the_opaque_gaussian_in_front():
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), (0, 0, 1), 45, 64, 48)
    gaussians = Gaussians.from_activated(
        means=[[0, 1, 0], [0, 0, 0], [0, -1, 0]],
        scales=np.full((3, 3), 0.3),
        quats=np.tile([1.0, 0, 0, 0], (3, 1)),
        opacities=[0.95, 0.9, 0.05],
        sh_coeffs=np.zeros((3, 1, 3)),
    )
    assert np.argmax(blend_weights(gaussians, camera, 32, 24, CONFIG)) == 1
    assert not blend_weights(gaussians, camera, 0, 0, CONFIG).any()


def test_description__states_the_attributes(tmp_path):
    states = write_stream(tmp_path / "stream.morgs")
    text = description(states[1], 3)
    assert text.startswith("**Gaussian 3** of 40")
    assert "motion (0.0999, 0, 0), 0.0999 units per frame" in text
    assert "confidence 0.95" in text
    assert f"opacity {np.asarray(states[1].gaussians.opacities)[3]:.2f}" in text
    assert description(states[3], 0) == "**Gaussian 0** does not exist in frame 3.", "it has died"

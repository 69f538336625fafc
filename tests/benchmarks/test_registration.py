"""Registration of a view, with splats of a known scene."""

import numpy as np
import pytest

from benchmarks.reports.registration import register_camera
from morgs_mi.core.view import View
from morgs_mi.extras.calibration.bundle import changed_camera
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import rendered
from morgs_mi.render.render_config import RenderConfig
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic

CHANGE = np.array([0.006, -0.008, 0.004, 0.01, 0.008, -0.01, 0.004, 0, 0, 0, 0])


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_register_camera__finds_the_camera_of_an_image(scale):
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (60, 3)).astype(np.float32)
    sh = rng.uniform(-1, 1.5, (60, 1, 3)).astype(np.float32)
    splats = isotropic(means, 0.15, 0.9, sh)
    (true,) = look_at_cameras([(-1, 0, -4)], 60, 64, 48)
    image = np.rint(255 * rendered(splats, true, RenderConfig())).astype(np.uint8)
    view = View(changed_camera(true, scale * CHANGE), image)
    camera = register_camera(splats, view, 1.0, FitConfig(), RenderConfig())
    error = np.square(rendered(splats, camera, RenderConfig()) - image / 255).mean()
    assert error < 1e-5, "the rounding to 8 bits alone has 1e-6"

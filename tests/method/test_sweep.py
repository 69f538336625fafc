"""Sums of a sweep over the key views, against each view rendered and back-projected on its own."""

import cv2
import numpy as np
import pytest

from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.method.sweep import MAPS, KeyImages
from morgs_mi.render.active_view import ActiveView, backproject
from morgs_mi.render.rasterize import render_view
from morgs_mi.testing import assert_close
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet


@pytest.fixture(scope="module")
def scene():
    """A textured wall in three views of two sizes, one of them masked, with blurred noise as
    targets.
    """
    rng = np.random.default_rng(0)
    wall = isotropic(
        random_sheet(rng, 300, 1.2, 0.6), 0.06, 0.8, rng.uniform(-1.5, 1.5, (300, 1, 3))
    )
    cameras = look_at_cameras([(x, 0.3, -3) for x in (-0.8, 0.1, 0.8)], 45, 80, 60)
    views = {
        4: ActiveView(cameras[0]),
        2: ActiveView(cameras[1].resized(53, 41)),
        7: ActiveView(cameras[2]),
    }
    sizes = [(view.camera.height, view.camera.width) for view in views.values()]
    images = [cv2.GaussianBlur(rng.random((*size, 3), np.float32), (0, 0), 2) for size in sizes]
    masks = [None, rng.random(sizes[1]) > 0.3, None]
    return (
        wall,
        {
            v: ObservedView.of(view, Target(image, mask))
            for (v, view), image, mask in zip(views.items(), images, masks, strict=True)
        },
    )


def expected(wall, view, target):
    """Return the sums of one view by name, from NumPy's maps."""
    error = target.difference(render_view(wall, view).color)
    x, y = (
        cv2.Sobel(target.image(), cv2.CV_32F, *order, ksize=3, scale=1 / 8)
        for order in ((1, 0), (0, 1))
    )
    maps = {
        "weight": np.ones(error.shape[:2]),
        "error": np.abs(error).mean(-1),
        "color": error,
        "normal": np.stack([(a * b).sum(-1) for a, b in ((x, x), (x, y), (y, y))], -1),
        "right": np.stack([(error * a).sum(-1) for a in (x, y)], -1),
    }
    shape = (*error.shape[:2], -1)
    return {name: backproject(wall, view, np.float32(m).reshape(shape)) for name, m in maps.items()}


def test_sums__are_the_sums_of_each_view(scene):
    wall, views = scene
    result = KeyImages(views).sums(wall, [*MAPS])
    # Sobel's filter reflects at the border in OpenCV, and repeats the last pixel here.
    mask = np.abs(np.asarray(wall.means)[:, :2]).max(axis=1) < 0.5
    assert mask.sum() > 20
    for k, view in enumerate(views.values()):
        for name, sums in expected(wall, view, view.target).items():
            mine = result[name][k].reshape(sums.shape)
            assert_close(mine[mask], sums[mask], rtol=1e-4, name=f"{name} of view {k}")

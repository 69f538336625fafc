"""An active view against the full view: same pixels, same gradients."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Gaussians, RenderConfig, rasterize
from morgs_mi.render.active_view import ActiveView, backproject
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.scenes.cameras import make_wide_camera
from tests.scenes.derivatives import backward, gradient
from tests.scenes.gaussians import CHANNELS, make_wide_scene
from tests.scenes.views import make_active_view

N = 120
ACTIVE = np.arange(0, 120, 5)


@pytest.fixture(scope="module")
def camera():
    return make_wide_camera()


@pytest.fixture(scope="module")
def gaussians():
    return Gaussians(**make_wide_scene(N))


@pytest.fixture(scope="module")
def mask(camera):
    y, x = np.mgrid[: camera.height, : camera.width]
    return (x - 30) ** 2 + (y - 20) ** 2 < 20**2


def split(camera, gaussians, mask):
    """Return the view of the static Gaussians, and the active Gaussians."""
    active = np.isin(np.arange(N), ACTIVE)
    view = make_active_view(
        camera, Region.of(mask), gaussians.select(~active), CHANNELS, RenderConfig()
    )
    return view, gaussians.select(active)


def drawn_pixels(view):
    """Return 1 on the pixels of the view's blocks [H, W], 0 elsewhere."""
    return np.asarray(view.region.mask, float)


def test_active_view__renders_and_differentiates_like_the_full_view(camera, gaussians, mask):
    view, active = split(camera, gaussians, mask)
    assert 0.1 < view.region.mask.mean() < 0.4
    dr.enable_grad(active.means, active.sh_coeffs, gaussians.means, gaussians.sh_coeffs)
    image = render_view(active, view, CHANNELS)
    full = rasterize(gaussians, camera, CHANNELS)
    for name in CHANNELS:
        assert_close(image[name], view.crop(np.asarray(full[name])), name=name)
    weight = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))
    drawn = drawn_pixels(view)[..., None]
    backward(image.color * mi.TensorXf(np.float32(view.crop(weight))))
    backward(full.color * mi.TensorXf(np.float32(weight * drawn)))
    for name in ("means", "sh_coeffs"):
        expected = gradient(getattr(gaussians, name))
        assert np.abs(expected[ACTIVE]).max() > 0
        bound = tol.SUM_ORDER_REL * np.abs(expected).max()
        assert_close(dr.grad(getattr(active, name)), expected[ACTIVE], atol=bound, name=name)


def test_active_view__backproject_accounts_for_static_splats(camera, gaussians, mask):
    view, active = split(camera, gaussians, mask)
    image = np.float32(np.random.default_rng(1).uniform(size=(camera.height, camera.width, 2)))
    expected = backproject(
        gaussians, ActiveView(camera), image * np.float32(drawn_pixels(view))[..., None]
    )[ACTIVE]
    assert expected.max() > 10
    assert_close(backproject(active, view, view.crop(image)), expected, rtol=tol.SUM_ORDER_REL)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera": None}, "`camera` must be a .*Camera, got a NoneType; convert a Mitsuba sensor"),
        ({"static_splats": "all"}, "`static_splats` must be a .*StaticSplats"),
    ],
)
def test_active_view__refuses_bad_arguments(camera, arguments, message):
    with pytest.raises(ValueError, match=rf"ActiveView\(\): {message}"):
        ActiveView(**{"camera": camera, **arguments})


def test_render_view__refuses_bad_arguments(camera, gaussians):
    with pytest.raises(ValueError, match=r"render_view\(\): `view` must be a .*ActiveView"):
        render_view(gaussians, camera)
    with pytest.raises(ValueError, match="`detach_weights` must be a sequence of names"):
        render_view(gaussians, ActiveView(camera), detach_weights="color")

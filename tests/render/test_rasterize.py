"""The renderer's images against the float64 reference, and the arguments that it refuses."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, RenderConfig, rasterize
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.reference import rasterize_view
from tests.scenes.cameras import make_camera
from tests.scenes.derivatives import backward, gradient, random_weight
from tests.scenes.gaussians import (
    CHANNELS,
    as_float32,
    isotropic,
    make_scene,
    to_gaussians,
)
from tests.scenes.kernels import compiled_by


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rasterize__agrees_with_the_reference_at_every_sh_degree(degree):
    raw = as_float32(make_scene(degree))
    camera = make_camera()
    image = rasterize(to_gaussians(raw), camera, ("color", "alpha"))
    expected = rasterize_view(raw, camera)
    for name in ("color", "alpha"):
        assert_close(image[name], expected[name], atol=tol.IMAGE_ABS, name=name)


def test_rasterize__agrees_with_the_reference_in_every_channel(scene):
    raw, camera = scene
    image = rasterize(to_gaussians(raw), camera, CHANNELS)
    expected = rasterize_view(raw, camera)
    for name in CHANNELS:
        # Where alpha is small, a normalised channel divides rounding errors by it.
        solid = expected["alpha"] > 0.02
        scale = max(1.0, np.abs(expected[name]).max())
        assert_close(
            image[name], expected[name], atol=tol.IMAGE_ABS * scale, where=solid, name=name
        )


@pytest.mark.parametrize(
    ("motion", "first_order", "expected"),
    [
        ((0.1, 0.05, 0.2), False, (5.643, 2.822)),
        ((0.1, 0.05, 0.2), True, (5.361, 2.681)),
        # Behind the camera one frame ago: to first order.
        ((0.1, 0.05, 4.2), False, (5.361, 2.681)),
    ],
)
def test_rasterize__motion_of_one_gaussian_has_the_closed_form(motion, first_order, expected):
    K = np.array([[214.44, 0, 8], [0, 214.44, 8], [0, 0, 1]])
    gaussian = replace(isotropic([[0, 0, 4.0]], 0.05, 0.9, 0.5), motion=np.float32([motion]))
    config = RenderConfig(first_order_motion=first_order)
    image = rasterize(gaussian, Camera(K, np.eye(4), 16, 16), ("motion",), config=config)
    assert np.asarray(image.motion)[8, 8] == pytest.approx(expected, abs=6e-4)


def test_rasterize__blends_features_like_the_confidence(scene):
    """Twelve columns, multiples of the confidence, have its image and its gradients."""
    raw, camera = scene
    confidence = 1 / (1 + np.exp(-raw["logit_confidence"]))
    factors = np.linspace(-2, 3, 12)
    weight = random_weight(camera, "confidence", 2)
    gaussians, expected = (to_gaussians(raw, grad=True) for _ in range(2))
    features = mi.TensorXf(np.float32(confidence[:, None] * factors))
    dr.enable_grad(features)
    image = rasterize(gaussians, camera, features=features).features
    expected_image = rasterize(expected, camera, ("confidence",)).confidence
    assert_close(image, np.asarray(expected_image) * factors, atol=4 * tol.IMAGE_ABS)
    backward(image * mi.TensorXf(np.float32(weight * factors)))
    backward(expected_image * mi.TensorXf(np.float32(weight * (factors @ factors))))
    slopes = confidence * (1 - confidence)
    expected_slopes = gradient(expected.logit_confidence)[:, None] * factors / (factors @ factors)
    assert_close(gradient(features) * slopes[:, None], expected_slopes, rtol=tol.GRADIENT_REL)
    assert_close(gradient(gaussians.means), gradient(expected.means), rtol=tol.GRADIENT_REL)


@pytest.mark.parametrize("shape", [(4, 4), (16, 2), (12, 5)])
def test_rasterize__image_does_not_depend_on_the_block_shape(scene, shape):
    raw, camera = scene
    config = RenderConfig(block_width=shape[0], block_height=shape[1])
    image = rasterize(to_gaussians(raw), camera, ("color",), config=config).color
    assert_close(image, rasterize_view(raw, camera)["color"], atol=tol.IMAGE_ABS)


def test_rasterize__stops_early_within_its_bound_in_a_dense_opaque_scene():
    """With hundreds of nearly opaque layers the lists are truncated; the image changes by at most
    the stop value.
    """
    rng = np.random.default_rng(6)
    raw = as_float32(make_scene(0, 300, seed=6))
    raw["logit_opacities"] = rng.uniform(2, 8, 300)
    raw = as_float32(raw)
    camera = make_camera(70, 45)
    image = rasterize(to_gaussians(raw), camera)
    expected = rasterize_view(raw, camera)
    assert expected["alpha"].max() > 1 - 1e-5
    assert_close(image.color, expected["color"], atol=tol.STOPPED_IMAGE_ABS)


def test_rasterize__of_no_gaussians_is_the_background(scene):
    raw, camera = scene
    image = rasterize(to_gaussians(raw).select(slice(0)), [camera] * 2, background=(0.1, 0.2, 0.3))
    assert np.allclose(np.asarray(image.color), (0.1, 0.2, 0.3))
    assert np.asarray(image.alpha).max() == 0


def test_rasterize__of_gaussians_out_of_view_is_empty_with_zero_gradients(scene):
    raw, camera = scene
    behind = {**raw, "means": raw["means"] - np.array([0, 0, 50.0])}
    gaussians = to_gaussians(behind, grad=True)
    image = rasterize(gaussians, camera, CHANNELS)
    backward(image.color)
    for name in CHANNELS:
        assert np.asarray(image[name]).max() == 0
    assert np.abs(gradient(gaussians.means)).max() == 0


BROKEN = np.where(np.arange(10)[:, None] == 3, np.nan, np.ones((10, 2)))
FEATURES = r"`features` must be \[N, F\] with N=10 and F from 1 to 12"
BACKGROUND = "`background` must be three finite numbers of at most 1e18, or an image"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gaussians": None}, "`gaussians` must be Gaussians, got a NoneType"),
        ({"channels": "color"}, "`channels` must be a sequence of names, got 'color'"),
        ({"channels": ("colour",)}, "`channels` must be out of alpha, color"),
        ({"background": (1, 2)}, BACKGROUND),
        ({"background": (0, 0, np.nan)}, BACKGROUND),
        ({"background": (0, 0, 1e30)}, BACKGROUND),
        ({"features": mi.Float(1)}, "`features` must be a NumPy array or a"),
        ({"features": np.ones((9, 2))}, FEATURES),
        ({"features": np.ones((10, 13))}, FEATURES),
        ({"features": BROKEN}, r"`features` must be finite, got nan at \[3, 0\]"),
        (
            {"features": np.full((10, 2), 1e20)},
            r"`features` must be at most 1e18, got 1e\+20 at \[0, 0\]",
        ),
    ],
)
def test_rasterize__refuses_bad_arguments(scene, arguments, message):
    raw, camera = scene
    with pytest.raises(ValueError, match=message):
        rasterize(**{"gaussians": to_gaussians(raw), "camera": camera, **arguments})


def test_rasterize__background_may_have_any_type_of_numbers(scene):
    raw, camera = scene
    gaussians = to_gaussians(raw)
    expected = rasterize(gaussians, camera, background=(0.5, 0.25, 1)).color
    exact = mi.Color3d(0.5, 0.25, 1)
    image = np.full((camera.height, camera.width, 3), [0.5, 0.25, 1], np.float16)
    dr.enable_grad(exact)
    for background in (mi.ScalarColor3f(0.5, 0.25, 1), exact, image, mi.TensorXf64(image)):
        color = rasterize(gaussians, camera, background=background).color
        assert np.array_equal(color, expected)
    backward(rasterize(gaussians, camera, background=exact).color)
    assert dr.grad(exact).x[0] > 0


def test_rasterize__refuses_a_pose_that_is_not_finite(scene):
    raw, camera = scene
    viewmat = np.float32(camera.viewmat)
    viewmat[2, 3] = np.nan
    posed = replace(camera, viewmat=mi.TensorXf(viewmat))
    with pytest.raises(ValueError, match=r"`camera.viewmat` must be finite, got nan at \[2, 3\]"):
        rasterize(to_gaussians(raw), posed)


def test_rasterize__refuses_to_be_frozen(scene):
    """Dr.Jit would end the process."""
    raw, camera = scene
    gaussians = to_gaussians(raw)
    frozen = dr.freeze(lambda means: rasterize(replace(gaussians, means=means), camera).color)
    with pytest.raises(RuntimeError) as error:
        frozen(gaussians.means)
    assert "rasterize(): expected a call outside dr.freeze" in str(error.value.__cause__)


def test_rasterize__copies_features_and_background_before_it_returns(scene):
    raw, camera = scene
    results = []
    for last in (1, 0):
        features = np.ones((10, 2), np.float32)
        background = np.full(3, 0.5)
        gaussians = to_gaussians(raw, grad=True)
        image = rasterize(gaussians, camera, features=features, background=background)
        features *= last
        background *= last
        dr.backward(dr.sum(image.color) + dr.sum(image.features))
        results.append((image.color, image.features, dr.grad(gaussians.means)))
    for expected, result in zip(*results, strict=True):
        assert_close(result, np.asarray(expected), atol=1e-5)


def test_rasterize__compiles_its_kernels_once_for_all_cameras_and_sizes():
    """No camera, image size or number of Gaussians may end up as a literal in a kernel."""

    def step(gaussians, camera):
        image = rasterize(gaussians, camera, ("color",))
        backward(image.color)
        dr.eval(dr.grad(gaussians.means), dr.grad(gaussians.quats))
        dr.sync_thread()

    small, large = (to_gaussians(make_scene(0, n, seed=n), grad=True) for n in (40, 70))
    step(small, make_camera(50, 41))
    assert not compiled_by(lambda: step(large, make_camera(90, 61)))

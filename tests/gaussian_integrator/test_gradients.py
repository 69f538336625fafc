"""The plugin `gaussian_splat`: derivatives of mi.render(scene, params)."""

from importlib import import_module

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import RenderConfig, rasterize
from morgs_mi.surfaces import gaussian_splat
from morgs_mi.testing import assert_close
from tests import reference
from tests import tolerances as tol
from tests.gaussian_integrator.expected import expected_image, to_linear
from tests.reference import rasterize_view
from tests.scenes.cameras import make_sensor_camera
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import to_gaussians
from tests.scenes.plugin import AOVS, make_mitsuba_scene

# Raw attributes, and their derivatives with respect to the activated parameters of a Mitsuba scene.
ACTIVATED = {
    "log_scales": lambda raw: 1 / np.exp(raw["log_scales"]),
    "logit_opacities": lambda raw: 2 + 2 * np.cosh(raw["logit_opacities"]),
    "logit_confidence": lambda raw: 2 + 2 * np.cosh(raw["logit_confidence"]),
}


def parameter_gradients(gradient, raw):
    """Return the gradient with respect to Mitsuba's parameters from the one with respect to raw
    attributes.
    """
    gradient = {
        name: g * ACTIVATED[name](raw) if name in ACTIVATED else g for name, g in gradient.items()
    }
    quats = np.roll(gradient["quats"], -1, axis=1)
    return {
        "gaussians.data": np.concatenate(
            [gradient["means"], gradient["log_scales"], quats], axis=1
        ).ravel(),
        "gaussians.opacities": gradient["logit_opacities"],
        "gaussians.sh_coeffs": gradient["sh_coeffs"].ravel(),
        "gaussians.motion": gradient["motion"].ravel(),
        "gaussians.confidence": gradient["logit_confidence"],
    }


@pytest.fixture(scope="module")
def weight(raw):
    """A random linear loss on all channels, where normalised channels do not divide by a small
    alpha.
    """
    solid = rasterize_view(raw, make_sensor_camera())["alpha"] > 0.02
    return np.float32(np.random.default_rng(1).normal(size=(*solid.shape[:2], 8)) * solid)


@pytest.fixture(scope="module")
def gradients(raw, weight):
    """The loss's gradient by Mitsuba's parameters, exact to rounding."""
    expected = reference.complex_step(
        lambda values: np.sum(expected_image(values) * weight), raw, list(raw)
    )
    return parameter_gradients(expected, raw)


def test_gaussian_splat__backward_agrees_with_the_reference_for_every_parameter(
    raw, weight, gradients
):
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    params = mi.traverse(scene)
    dr.enable_grad([params[name] for name in gradients])
    backward(mi.render(scene, params) * mi.TensorXf(weight))
    for name, expected in gradients.items():
        assert_close(dr.grad(params[name]), expected, rtol=tol.GRADIENT_REL, name=name)


def test_gaussian_splat__forward_agrees_with_the_reference(raw, weight, gradients):
    """All parameters change at once; the derivative of the loss is <gradient, direction>."""
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, aovs=AOVS)
    params = mi.traverse(scene)
    rng = np.random.default_rng(2)
    slope = 0.0
    for name, gradient in gradients.items():
        # The direction is the sign of the gradient: no cancellation hides an error.
        direction = np.float32(np.sign(gradient) * rng.uniform(0.5, 1, gradient.shape))
        dr.enable_grad(params[name])
        dr.set_grad(params[name], mi.Float(direction))
        slope += np.vdot(gradient, direction)
    image = mi.render(scene, params)
    dr.forward_to(image)
    derivative = np.sum(np.asarray(dr.grad(image), np.float64) * weight)
    assert derivative == pytest.approx(slope, rel=tol.GRADIENT_REL)


def test_gaussian_splat__gradient_of_the_sensors_pose(raw):
    """The camera moves to its left by t: to_world = M T(t); viewmat moves points to the right."""
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    params["sensor.to_world"] = params["sensor.to_world"] @ mi.AffineTransform4f().translate(
        [t, 0, 0]
    )
    params.update()
    backward(dr.square(mi.render(scene, params)))
    right = np.zeros((4, 4))
    right[0, 3] = 1
    viewmat = np.float32(make_sensor_camera().viewmat).astype(np.float64)
    expected = reference.directional(
        lambda v: np.sum(expected_image(raw, v["viewmat"])[..., :3] ** 2),
        {"viewmat": viewmat},
        {"viewmat": right},
    )
    assert dr.grad(t)[0] == pytest.approx(expected, rel=10 * tol.GRADIENT_REL)


@pytest.mark.slow
def test_gaussian_splat__differentiates_filter_and_crop(raw):
    """<g, J v> = <J' g, v> through a film that blurs, crops and normalises."""
    film = {
        "rfilter": {"type": "gaussian"},
        "crop_offset_x": 3,
        "crop_offset_y": 2,
        "crop_width": 11,
        "crop_height": 12,
    }
    scene = make_mitsuba_scene(
        to_gaussians(raw), {**film, "pixel_format": "luminance_alpha"}, aovs=AOVS
    )
    params = mi.traverse(scene)
    data = params["gaussians.data"]
    rng = np.random.default_rng(5)
    g, v = (np.float32(rng.normal(size=s)) for s in ((12, 11, 6), dr.width(data)))
    dr.enable_grad(data)
    dr.set_grad(data, mi.Float(v))
    image = mi.render(scene, params)
    dr.forward_to(image)
    forward = np.vdot(np.asarray(dr.grad(image), np.float64), g)
    dr.set_grad(data, 0)
    backward(mi.render(scene, params) * mi.TensorXf(g))
    assert np.vdot(np.asarray(dr.grad(data), np.float64), v) == pytest.approx(
        forward, rel=tol.DUALITY_REL
    )


# Change of K by a parameter of the sensor, for a film of W x H pixels.
INTRINSICS = {
    "x_fov": lambda K, W, H: (
        np.diag([1, 1, 0]) * -0.5 * np.deg2rad(1) * (K[0, 0] ** 2 / (W / 2) + W / 2)
    ),
    "principal_point_offset_x": lambda K, W, H: np.array([[0, 0, -W], [0, 0, 0], [0, 0, 0]]),
    "principal_point_offset_y": lambda K, W, H: np.array([[0, 0, 0], [0, 0, -H], [0, 0, 0]]),
}


@pytest.mark.parametrize("name", INTRINSICS)
def test_gaussian_splat__gradient_of_the_sensors_intrinsics(raw, name):
    camera = make_sensor_camera()
    scene = make_mitsuba_scene(to_gaussians(raw))
    viewmat, K = (np.float32(matrix).astype(np.float64) for matrix in (camera.viewmat, camera.K))

    def loss(values):
        image = reference.rasterize(raw, values["K"], viewmat, camera.width, camera.height)["color"]
        return np.sum(to_linear(image) ** 2)

    change = INTRINSICS[name](K, camera.width, camera.height)
    expected = reference.directional(loss, {"K": K}, {"K": change})
    params = mi.traverse(scene)
    parameter = params[f"sensor.{name}"]
    dr.enable_grad(parameter)
    params.update()
    backward(dr.square(mi.render(scene, params)))
    assert dr.grad(parameter)[0] == pytest.approx(expected, rel=10 * tol.GRADIENT_REL)
    dr.set_grad(parameter, 1)
    image = mi.render(scene, params)
    dr.forward_to(image)
    slope = 2 * np.vdot(np.asarray(image, np.float64), np.asarray(dr.grad(image)))
    assert slope == pytest.approx(expected, rel=10 * tol.GRADIENT_REL)


def test_gaussian_splat__has_the_gradients_of_rasterize_to_the_bit(raw):
    """With the same settings, in a fixed order, and through a film that changes nothing."""
    film = {"rfilter": {"type": "box"}}
    scene = make_mitsuba_scene(to_gaussians(raw), film, srgb_primitives=False)
    params = mi.traverse(scene)
    camera = make_sensor_camera()
    weight = mi.TensorXf(
        np.float32(np.random.default_rng(8).normal(size=(camera.height, camera.width, 3)))
    )
    names = ("gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs")

    def gradients(image):
        backward(image * weight)
        grads = [np.array(dr.grad(params[name])) for name in names]
        for name in names:
            dr.set_grad(params[name], 0)
        return grads

    dr.enable_grad([params[name] for name in names])
    shape = scene.shapes()[0]
    splats = gaussian_splat._SceneGaussians(
        **gaussian_splat._shape_gaussians(shape, ["opacities", "sh_coeffs"])
    )
    camera = gaussian_splat._sensor_camera(scene.sensors()[0], border=0)
    plugin = gradients(mi.render(scene, params))
    direct = gradients(rasterize(splats, camera, ("color",), config=RenderConfig()).color)
    for name, by_plugin, by_rasterize in zip(names, plugin, direct, strict=True):
        assert_array_equal(by_plugin, by_rasterize, err_msg=name)


def counting_renders(monkeypatch):
    """Return a list that grows with every call of the rasteriser by the integrator."""
    calls = []
    # A change of the variant imports the module again.
    module = import_module("morgs_mi.surfaces.gaussian_splat")
    draw = module.rasterize
    monkeypatch.setattr(
        module, "rasterize", lambda *args, **kwargs: calls.append(1) or draw(*args, **kwargs)
    )
    return calls


def test_gaussian_splat__backward_uses_the_rendering_of_the_same_parameters(raw, monkeypatch):
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    opacities = params["gaussians.opacities"]
    dr.enable_grad(opacities)
    calls = counting_renders(monkeypatch)
    backward(dr.square(mi.render(scene, params)))
    assert len(calls) == 1
    derivative = np.array(dr.grad(opacities))
    assert np.abs(derivative).max() > 0

    # Only the last rendering is kept: the earlier one of two images is rendered again.
    dr.set_grad(opacities, 0)
    images = [mi.render(scene, params) for _ in range(2)]
    dr.backward(dr.sum(dr.square(images[0]), axis=None) + dr.sum(dr.square(images[1]), axis=None))
    assert len(calls) == 1 + 2 + 1
    assert_close(np.array(dr.grad(opacities)), 2 * derivative, rtol=1e-6)


def test_gaussian_splat__backward_renders_what_has_changed_since(raw):
    """A sensor that moved between the two passes is used as it is, like Mitsuba's own integrators
    use it.
    """

    def gradient(zoom):
        scene = make_mitsuba_scene(to_gaussians(raw))
        params = mi.traverse(scene)
        dr.enable_grad(params["gaussians.opacities"])
        for moment in ("before", "after"):
            if zoom == moment:
                params["sensor.x_fov"] = mi.Float(60)
                params.update()
            if moment == "before":
                loss = dr.sum(mi.render(scene, params), axis=None)
        dr.backward(loss)
        return np.array(dr.grad(params["gaussians.opacities"]))

    assert_array_equal(gradient("after"), gradient("before"))
    assert np.abs(gradient("after") - gradient("never")).max() > 0.01


def test_gaussian_splat__gradient_of_the_background(raw):
    """Encoded, so that the image is linear in it."""
    props = {"background": {"type": "rgb", "value": (0.2, 0.4, 0.6)}, "srgb_primitives": False}
    scene = make_mitsuba_scene(to_gaussians(raw), {"pixel_format": "rgba"}, **props)
    params = mi.traverse(scene)
    background = params["integrator.background"]
    dr.enable_grad(background)
    image = mi.render(scene, params)
    weight = np.float32(np.random.default_rng(7).normal(size=(*image.shape[:2], 3)))
    backward(image[:, :, :3] * mi.TensorXf(weight))
    transmitted = 1 - rasterize_view(raw, make_sensor_camera())["alpha"]
    assert_close(
        np.array(dr.grad(background)).ravel(),
        (transmitted * weight).sum((0, 1)),
        rtol=tol.GRADIENT_REL,
    )


def test_gaussian_splat__tangents_stay_for_further_terms_of_a_loss(raw):
    """Two images and the parameter itself, with a parameter that depends on another variable."""
    scene = make_mitsuba_scene(to_gaussians(raw))
    params = mi.traverse(scene)
    start = mi.Float(params["gaussians.opacities"])
    x = mi.Float(0)

    def loss():
        params["gaussians.opacities"] = start * dr.exp(x)
        params.update()
        images = [dr.mean(mi.render(scene, params), axis=None) for _ in range(2)]
        return images[0].array + images[1].array + dr.mean(params["gaussians.opacities"])

    dr.enable_grad(x)
    dr.set_grad(x, 1)
    value = loss()
    dr.forward_to(value)
    tangent = dr.grad(value)[0]
    x = mi.Float(0)
    dr.enable_grad(x)
    backward(loss())
    assert dr.grad(x)[0] == pytest.approx(tangent, rel=tol.DUALITY_REL)

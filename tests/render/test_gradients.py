"""Derivatives of the renderer in both modes: against the float64 reference, central differences and
each other.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, RenderConfig, rasterize
from morgs_mi.testing import assert_close
from tests import reference
from tests import tolerances as tol
from tests.reference import rasterize_view
from tests.scenes.cameras import make_camera
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import (
    CHANNELS,
    RAW,
    as_float32,
    make_scene,
    to_gaussians,
)


@pytest.mark.parametrize("channel", CHANNELS)
def test_rasterize__backward_agrees_with_the_reference_for_every_attribute(scene, channel):
    raw, camera = scene
    rng = np.random.default_rng(1)
    size = {"color": 3, "motion": 2}.get(channel, 1)
    weight = rng.normal(size=(camera.height, camera.width, size)) * (
        rasterize_view(raw, camera)["alpha"] > 0.02
    )
    background = (0.2, 0.5, 0.9) if channel == "color" else None

    gaussians = to_gaussians(raw, grad=True)
    image = rasterize(gaussians, camera, (channel,), background)
    backward(image[channel] * mi.TensorXf(np.float32(weight)))
    expected = reference.complex_step(
        lambda values: np.sum(rasterize_view(values, camera, background)[channel] * weight),
        raw,
        list(RAW),
    )
    for name in RAW:
        gradient = np.asarray(dr.grad(getattr(gaussians, name)))
        assert np.isfinite(gradient).all()
        if np.abs(expected[name]).max() == 0:
            assert np.abs(gradient).max() == 0, f"{channel} must not depend on {name}"
        else:
            assert_close(gradient, expected[name], rtol=tol.GRADIENT_REL, name=name)


def test_rasterize__antialiased_image_and_gradient_agree_with_the_reference(scene):
    raw, camera = scene
    raw = {**raw, "log_scales": raw["log_scales"] - 1.5}  # about a pixel, where the filter matters
    weight = np.random.default_rng(5).normal(size=(camera.height, camera.width, 3))

    def image_of(values):
        return rasterize_view(values, camera, antialiased=True)["color"]

    gaussians = to_gaussians(raw, grad=True)
    color = rasterize(gaussians, camera, ("color",), config=RenderConfig(antialiased=True)).color
    backward(color * mi.TensorXf(np.float32(weight)))
    assert_close(color, image_of(raw), atol=tol.IMAGE_ABS)
    assert np.abs(image_of(raw) - rasterize_view(raw, camera)["color"]).max() > 0.1
    names = ["means", "log_scales", "quats", "logit_opacities"]
    expected = reference.complex_step(lambda values: np.sum(image_of(values) * weight), raw, names)
    for name in names:
        assert_close(
            dr.grad(getattr(gaussians, name)), expected[name], rtol=tol.GRADIENT_REL, name=name
        )


def test_rasterize__forward_mode_agrees_with_the_reference(scene):
    raw, camera = scene
    rng = np.random.default_rng(2)
    direction = {
        name: np.float32(rng.normal(size=raw[name].shape)).astype(np.float64) for name in RAW
    }
    gaussians = to_gaussians(raw, grad=True)
    image = rasterize(gaussians, camera, CHANNELS)
    for name in RAW:
        dr.set_grad(getattr(gaussians, name), mi.TensorXf(np.float32(direction[name])))
    outputs = [image[name] for name in CHANNELS]
    dr.forward_to(outputs)
    for name, output in zip(CHANNELS, outputs, strict=True):
        expected = reference.directional(
            lambda v, name=name: rasterize_view(v, camera)[name], raw, direction
        )
        solid = rasterize_view(raw, camera)["alpha"] > 0.02
        assert_close(dr.grad(output), expected, rtol=tol.GRADIENT_REL, where=solid, name=name)


def test_rasterize__forward_and_reverse_mode_are_dual(scene):
    """<g, J v> = <J' g, v> for random g and v over all channels and attributes at once."""
    raw, camera = scene
    rng = np.random.default_rng(3)
    directions = {name: np.float32(rng.normal(size=raw[name].shape)) for name in RAW}

    def loss(gaussians):
        image = rasterize(gaussians, camera, ("color", "confidence"), (0.1, 0.2, 0.3))
        return dr.sum(dr.square(image.color), axis=None) + dr.sum(
            dr.sin(3 * image.confidence), axis=None
        )

    gaussians = to_gaussians(raw, grad=True)
    dr.backward(loss(gaussians))
    reverse = sum(
        np.vdot(np.asarray(dr.grad(getattr(gaussians, n)), np.float64), v)
        for n, v in directions.items()
    )
    gaussians = to_gaussians(raw, grad=True)
    value = loss(gaussians)
    for name, v in directions.items():
        dr.set_grad(getattr(gaussians, name), mi.TensorXf(v))
    dr.forward_to(value)
    forward = float(np.asarray(dr.grad(value)).ravel()[0])
    assert forward == pytest.approx(reverse, rel=tol.DUALITY_REL)


def test_rasterize__backward_agrees_with_central_differences(scene):
    raw, camera = scene

    def loss(values):
        return dr.sum(
            dr.square(rasterize(to_gaussians(values), camera, ("color",)).color), axis=None
        )

    gaussians = to_gaussians(raw, grad=True)
    backward(dr.square(rasterize(gaussians, camera, ("color",)).color))
    rng = np.random.default_rng(4)
    for name in RAW[:5]:
        # The direction is the sign of the gradient: no cancellation hides an error.
        grad = np.asarray(dr.grad(getattr(gaussians, name)), np.float64)
        v = np.sign(grad) * rng.uniform(0.5, 1, grad.shape)
        h = 2e-3
        up, down = ({**raw, name: raw[name] + s * h * v} for s in (1, -1))
        difference = (np.asarray(loss(up)).item() - np.asarray(loss(down)).item()) / (2 * h)
        assert difference == pytest.approx(np.vdot(grad, v), rel=tol.CENTRAL_DIFFERENCE_REL), name


def test_rasterize__gradient_of_the_pose_agrees_with_the_reference(scene):
    raw, camera = scene
    viewmat = np.float32(camera.viewmat).astype(np.float64)
    posed = Camera(camera.K, mi.TensorXf(np.float32(viewmat)), camera.width, camera.height)
    dr.enable_grad(posed.viewmat)
    image = rasterize(to_gaussians(raw), posed, ("color", "alpha"))
    dr.backward(dr.sum(dr.square(image.color), axis=None) + dr.sum(image.alpha, axis=None))

    def loss(values):
        image = rasterize_view(raw, camera, viewmat=values["viewmat"])
        return np.sum(image["color"] ** 2) + np.sum(image["alpha"])

    expected = reference.complex_step(loss, {"viewmat": viewmat}, ["viewmat"])["viewmat"]
    assert_close(np.asarray(dr.grad(posed.viewmat))[:3], expected[:3], rtol=tol.GRADIENT_REL)


def test_rasterize__detached_weights_give_geometry_no_gradient(scene):
    raw, camera = scene
    gaussians = to_gaussians(raw, grad=True)
    image = rasterize(gaussians, camera, ("color", "motion"), detach_weights=("motion",))
    backward(image.motion)
    assert np.abs(np.asarray(dr.grad(gaussians.motion))).max() > 0
    for name in ("log_scales", "quats", "logit_opacities", "sh_coeffs"):
        assert np.abs(np.asarray(dr.grad(getattr(gaussians, name)))).max() == 0, name


@pytest.mark.slow
def test_rasterize__backward_agrees_with_the_reference_in_a_dense_scene():
    raw = as_float32(make_scene(0, 40, seed=7))
    camera = make_camera(30, 25)
    weight = np.random.default_rng(8).normal(size=(25, 30, 3))
    gaussians = to_gaussians(raw, grad=True)
    backward(rasterize(gaussians, camera, ("color",)).color * mi.TensorXf(np.float32(weight)))
    names = ["means", "log_scales", "logit_opacities"]
    expected = reference.complex_step(
        lambda v: np.sum(rasterize_view(v, camera)["color"] * weight), raw, names
    )
    for name in names:
        assert_close(
            dr.grad(getattr(gaussians, name)), expected[name], rtol=10 * tol.GRADIENT_REL, name=name
        )


@pytest.mark.skipif("llvm" not in mi.variant(), reason="a GPU sums in no fixed order")
@pytest.mark.parametrize("count", [1, 400])
@pytest.mark.parametrize("size", [(120, 90), (9, 5), (2900, 2200)])
def test_rasterize__gradients_have_the_same_bytes_in_each_run(count, size):
    """The largest image takes several launches of the adjoint."""
    raw = as_float32(make_scene(1, count, seed=9))
    camera = make_camera(*size)

    def gradients(threads):
        dr.set_thread_count(threads)
        gaussians = to_gaussians(raw, grad=True)
        image = rasterize(gaussians, camera, ("color", "alpha"))
        dr.backward(dr.sum(dr.sin(5 * image.color), axis=None) + dr.sum(image.alpha, axis=None))
        return {name: np.array(dr.grad(value)) for name, value in gaussians.items().items()}

    threads = dr.thread_count()
    try:
        first, single, second, other = [gradients(n) for n in (threads, 1, threads, 3)]
    finally:
        dr.set_thread_count(threads)
    for name, expected in first.items():
        assert np.array_equal(second[name], expected), name
        if np.abs(expected).max() > 0:
            for run in (single, other):
                assert_close(run[name], expected, rtol=tol.GRADIENT_REL, name=name)

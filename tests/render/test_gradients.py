"""Derivatives of the renderer in both modes: against the float64 reference, central differences and
each other.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, RenderConfig, rasterize
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.testing import assert_close
from tests import reference
from tests import tolerances as tol
from tests.reference import rasterize_view
from tests.scenes.cameras import make_camera
from tests.scenes.derivatives import (
    assert_backward_agrees_with_differences,
    assert_forward_agrees_with_reference,
    assert_gradients_of_reference,
    backward,
    gradient,
    random_direction,
    random_weight,
    tangents,
)
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
    weight = random_weight(camera, channel, 1) * (rasterize_view(raw, camera)["alpha"] > 0.02)
    background = (0.2, 0.5, 0.9) if channel == "color" else None
    assert_gradients_of_reference(raw, camera, channel, weight, background=background)


def test_rasterize__antialiased_image_and_gradient_agree_with_the_reference(scene):
    raw, camera = scene
    raw = {**raw, "log_scales": raw["log_scales"] - 1.5}  # about a pixel, where the filter matters
    config = RenderConfig(antialiased=True)
    color = rasterize(to_gaussians(raw), camera, ("color",), config=config).color
    expected = rasterize_view(raw, camera, antialiased=True)["color"]
    assert_close(color, expected, atol=tol.IMAGE_ABS)
    assert np.abs(expected - rasterize_view(raw, camera)["color"]).max() > 0.1
    assert_gradients_of_reference(
        raw,
        camera,
        "color",
        random_weight(camera, "color", 5),
        names=("means", "log_scales", "quats", "logit_opacities"),
        antialiased=True,
    )


def test_rasterize__forward_mode_agrees_with_the_reference(scene):
    assert_forward_agrees_with_reference(*scene, CHANNELS, tol.GRADIENT_REL)


def test_rasterize__forward_and_reverse_mode_are_dual(scene):
    """<g, J v> = <J' g, v> for random g and v over all channels and attributes at once."""
    raw, camera = scene
    directions = random_direction(raw, 3)

    def loss(gaussians):
        image = rasterize(gaussians, camera, ("color", "confidence"), (0.1, 0.2, 0.3))
        return dr.sum(dr.square(image.color), axis=None) + dr.sum(
            dr.sin(3 * image.confidence), axis=None
        )

    gaussians = to_gaussians(raw, grad=True)
    dr.backward(loss(gaussians))
    reverse = sum(np.vdot(gradient(getattr(gaussians, n)), v) for n, v in directions.items())
    gaussians = to_gaussians(raw, grad=True)
    (forward,) = tangents(gaussians, directions, [loss(gaussians)])
    assert forward.item() == pytest.approx(reverse, rel=tol.DUALITY_REL)


def test_rasterize__backward_agrees_with_central_differences(scene):
    assert_backward_agrees_with_differences(*scene, RAW[:5])


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
    image = render_view(
        gaussians, ActiveView(camera), ("color", "motion"), detach_weights=("motion",)
    )
    backward(image.motion)
    assert np.abs(np.asarray(dr.grad(gaussians.motion))).max() > 0
    for name in ("log_scales", "quats", "logit_opacities", "sh_coeffs"):
        assert np.abs(np.asarray(dr.grad(getattr(gaussians, name)))).max() == 0, name


@pytest.mark.slow
def test_rasterize__backward_agrees_with_the_reference_in_a_dense_scene():
    camera = make_camera(30, 25)
    assert_gradients_of_reference(
        as_float32(make_scene(0, 40, seed=7)),
        camera,
        "color",
        random_weight(camera, "color", 8),
        names=("means", "log_scales", "logit_opacities"),
        rtol=10 * tol.GRADIENT_REL,
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

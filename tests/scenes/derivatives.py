"""Derivatives of tensors and of rendered Gaussians, and what they are compared with."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import RenderConfig, rasterize
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.testing import assert_close
from tests import reference
from tests import tolerances as tol
from tests.reference import rasterize_view
from tests.scenes.gaussians import RAW, to_gaussians


def backward(tensor):
    """Backpropagate from the sum of a tensor."""
    dr.backward(dr.sum(tensor, axis=None))


def gradient(tensor):
    """Return a copy of the gradient of a tensor, float64."""
    return np.array(dr.grad(tensor), np.float64)


def difference(function, at, direction, step):
    """Return the central difference of a scalar along a direction."""
    up, down = (np.asarray(function(np.asarray(at) + s * step * direction)).item() for s in (1, -1))
    return (up - down) / (2 * step)


def tangents(gaussians, direction, outputs):
    """Return the derivatives of tensors along a change of the attributes."""
    for name, change in direction.items():
        dr.set_grad(getattr(gaussians, name), mi.TensorXf(np.float32(change)))
    dr.forward_to(outputs)
    return [gradient(output) for output in outputs]


def random_direction(raw, seed):
    rng = np.random.default_rng(seed)
    return {n: np.float32(rng.normal(size=raw[n].shape)).astype(np.float64) for n in RAW}


def random_weight(camera, channel, seed):
    size = {"color": 3, "motion": 2}.get(channel, 1)
    return np.random.default_rng(seed).normal(size=(camera.height, camera.width, size))


def assert_gradients_of_reference(
    raw, camera, channel, weight, *, rtol=tol.GRADIENT_REL, names=RAW, antialiased=False, **options
):
    """Compare the gradients of the weighted sum of a channel, zero where the reference's are."""
    gaussians = to_gaussians(raw, grad=True)
    config = RenderConfig(antialiased=antialiased)
    image = render_view(gaussians, ActiveView(camera, config), (channel,), **options)
    backward(image[channel] * mi.TensorXf(np.float32(weight)))

    def loss(values):
        image = rasterize_view(values, camera, antialiased=antialiased, **options)
        return np.sum(image[channel] * weight)

    for name, expected in reference.complex_step(loss, raw, names).items():
        result = gradient(getattr(gaussians, name))
        if expected.any():
            assert_close(result, expected, rtol=rtol, name=name)
        else:
            assert not result.any(), f"{channel} must not depend on {name}"


def assert_forward_agrees_with_reference(raw, camera, channels, rtol, **limit):
    """Compare the derivatives of channels along a random change of all attributes."""
    direction = random_direction(raw, 2)
    gaussians = to_gaussians(raw, grad=True)
    image = render_view(gaussians, ActiveView(camera), channels, **limit)
    solid = rasterize_view(raw, camera, **limit)["alpha"] > 0.02
    results = tangents(gaussians, direction, [image[name] for name in channels])
    for name, result in zip(channels, results, strict=True):
        expected = reference.directional(
            lambda v, name=name: rasterize_view(v, camera, **limit)[name], raw, direction
        )
        where = solid if name in ("depth", "motion") else True
        assert_close(result, expected, rtol=rtol, where=where, name=name)


def assert_backward_agrees_with_differences(raw, camera, names):
    """Compare the slope of the squared image along each attribute."""

    def loss(gaussians):
        return dr.sum(dr.square(rasterize(gaussians, camera, ("color",)).color), axis=None)

    gaussians = to_gaussians(raw, grad=True)
    dr.backward(loss(gaussians))
    rng = np.random.default_rng(4)
    for name in names:
        # The direction is the sign of the gradient: no cancellation hides an error.
        grad = gradient(getattr(gaussians, name))
        v = np.sign(grad) * rng.uniform(0.5, 1, grad.shape)
        slope = difference(
            lambda value, name=name: loss(to_gaussians({**raw, name: value})), raw[name], v, 2e-3
        )
        assert slope == pytest.approx(np.vdot(grad, v), rel=tol.CENTRAL_DIFFERENCE_REL), name

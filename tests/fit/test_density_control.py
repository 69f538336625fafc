"""Density control in a loop of one's own."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import morgs_mi
from morgs_mi import Camera, DensityControl, Gaussians, rasterize
from morgs_mi.testing import assert_close
from tests.scenes.derivatives import backward, gradient
from tests.scenes.gaussians import isotropic

CAMERA = Camera.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), 50, 48, 36)
MEANS = np.array([(-0.8, 0, 0), (0, 0, 0), (0.8, 0, 0)], np.float32)


def splats(logits=(1.0, 1.0, 1.0)):
    gaussians = isotropic(MEANS, 0.1, 0.9, np.zeros((3, 1, 3), np.float32))
    return Gaussians(**{**gaussians.numpy(), "logit_opacities": np.float32(logits)})


def optimizer_of(gaussians):
    """Return Adam after a step that keeps the parameters."""
    optimizer = mi.ad.Adam(lr=0.0, params=gaussians.parameters())
    for name in optimizer:
        backward(dr.square(optimizer[name]))
    optimizer.step()
    return optimizer


def recorded(gaussians):
    return np.clip(np.array(rasterize(gaussians, CAMERA).color), 0, 1).astype(np.float32)


def test_density_control__adds_where_a_view_has_its_error():
    optimizer = optimizer_of(splats())
    image = recorded(splats())
    image[:, 32:] = 1  # behind the third splat
    control = DensityControl([CAMERA])
    control.observe(optimizer, CAMERA, image)
    control.observe(optimizer, CAMERA, recorded(splats()))  # which has no error
    assert control.scores.argmax() == 2
    plan = control.step(optimizer, births=1)
    assert (plan.parent.tolist(), plan.source.tolist()) == ([0, 1, 2, 2], [0, 1, 2, -1])
    assert {len(np.array(optimizer[name])) for name in optimizer} == {4}
    assert control.scores is None


def test_density_control__carries_moments_and_prunes_faint_gaussians():
    optimizer = optimizer_of(splats(logits=(1, -9, 1)))
    control = DensityControl([CAMERA])
    control.scores = np.array([0, 9, 1.0])
    old_moments = optimizer.state["means"][3][1:3]
    plan = control.step(optimizer, births=1)
    assert plan.parent.tolist() == [0, 2, 2]
    for old, new in zip(old_moments, optimizer.state["means"][3][1:3], strict=True):
        old_rows, new_rows = (np.reshape(moment, (3, 3)) for moment in (old, new))
        assert_close(new_rows, old_rows[[0, 2, 2]] * [[1], [1], [0]])
        assert new_rows[:2].any()
    assert len(Gaussians.from_parameters(optimizer)) == 3


def test_density_control__refuses_scores_of_other_gaussians_and_missing_parameters():
    control = DensityControl([CAMERA])
    for scores, message in ((np.zeros(2), r"\[3\]"), ([1, np.nan, 0], "finite, got nan; set")):
        control.scores = scores
        with pytest.raises(ValueError, match=f"`scores` must be {message}"):
            control.step(optimizer_of(splats()), births=1)
    with pytest.raises(ValueError, match="none of the name means"):
        control.step(mi.ad.Adam(lr=0.0, params={"data": mi.TensorXf([1.0])}), births=1)
    with pytest.raises(ValueError, match="`cameras` or `extent` must be given"):
        DensityControl()


@pytest.mark.parametrize("births", [-1, 10**9, 1.5])
def test_density_control__refuses_absurd_births(births):
    with pytest.raises(
        ValueError, match=r"step\(\): `births` must be .*at least 0 and at most 1000"
    ):
        DensityControl([CAMERA]).step(optimizer_of(splats()), births)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"extent": -1}, r": `extent` must be a number in \(0, 1e\+12\], got -1"),
        ({"render": {}}, r": `render` must be a .*RenderConfig, got a dict"),
        ({"cameras": None}, r": `cameras` must be a .*Sequence, got a NoneType"),
        ({"seed": "x"}, ", `seed`: "),
    ],
)
def test_density_control__refuses_absurd_arguments(arguments, message):
    with pytest.raises(ValueError, match=rf"^DensityControl\(\){message}"):
        DensityControl(**{"cameras": [CAMERA], **arguments})


@pytest.mark.parametrize(
    ("image", "mask", "message"),
    [
        (np.zeros((36, 48)), None, r"`image` must be .* \[36, 48, 3\], got float64 \[36, 48\]"),
        (np.zeros((36, 48, 3)), np.ones((2, 2), bool), r"the mask must be bool \[36, 48\]"),
    ],
)
def test_density_control__refuses_absurd_images(image, mask, message):
    with pytest.raises(ValueError, match=rf"^DensityControl.observe\(\): {message}"):
        DensityControl([CAMERA]).observe(optimizer_of(splats()), CAMERA, image, mask)


def test_update_ellipsoids__follows_another_number_of_gaussians_with_gradients():
    shape = morgs_mi.ellipsoids(splats())
    integrator = {"type": "gaussian_splat", "srgb_primitives": False}
    scene = mi.load_dict({"type": "scene", "gaussians": shape, "integrator": integrator})
    params = mi.traverse(scene)
    sensor = mi.load_dict(CAMERA.sensor())
    optimizer = optimizer_of(splats())
    control = DensityControl([sensor])
    control.scores = np.array([0, 0, 1.0])
    control.step(optimizer, births=1)
    gaussians = Gaussians.from_parameters(optimizer)
    morgs_mi.update_ellipsoids(params, gaussians)
    image = mi.render(scene, params, sensor=sensor)
    assert_close(image, rasterize(gaussians, CAMERA).color, atol=1e-5)
    backward(image)
    assert np.abs(gradient(optimizer["means"])).max() > 0
    with pytest.raises(ValueError, match=r"must have other\.data"):
        morgs_mi.update_ellipsoids(params, gaussians, "other")


def test_update_ellipsoids__refuses_gaussians_that_lack_what_the_shape_has():
    moving = replace(splats(), motion=np.zeros((len(splats()), 3)))
    scene = mi.load_dict({"type": "scene", "gaussians": morgs_mi.ellipsoids(moving)})
    params = mi.traverse(scene)
    with pytest.raises(ValueError, match="`gaussians` must have `motion`, as the shape has"):
        morgs_mi.update_ellipsoids(params, splats())
    with pytest.raises(ValueError, match="at least one"):
        morgs_mi.update_ellipsoids(params, moving.select(np.zeros(len(moving), bool)))
    with pytest.raises(ValueError, match="`params` must be"):
        morgs_mi.update_ellipsoids(scene, moving)

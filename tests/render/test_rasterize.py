"""The renderer against the float64 reference: image and derivatives, every attribute and every channel."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, RenderConfig, rasterize
from morgs_mi.core.attributes import BY_ACTIVATED_NAME
from morgs_mi.render.region import Region
from tests import reference
from tests import tolerances as tol
from tests.assertions import assert_close
from tests.reference import rasterize_view
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import (
    CHANNELS,
    NEW_ATTRIBUTES,
    RAW,
    ExtendedGaussians,
    as_float32,
    make_scene,
    to_gaussians,
)


@pytest.fixture(scope="module")
def scene():
    raw, camera = as_float32(make_scene()), make_camera()
    assert rasterize_view(raw, camera)["margin"] > 1e-5, "the scene must stay clear of the cut-offs"
    return raw, camera


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rasterize__agrees_with_the_reference_at_every_sh_degree(degree):
    raw, camera = as_float32(make_scene(degree)), make_camera()
    image, expected = rasterize(to_gaussians(raw), camera, ("color", "alpha")), rasterize_view(raw, camera)
    for name in ("color", "alpha"):
        assert_close(image[name], expected[name], atol=tol.IMAGE_ABS, name=name)


def test_rasterize__agrees_with_the_reference_in_every_channel(scene):
    raw, camera = scene
    image, expected = rasterize(to_gaussians(raw), camera, CHANNELS), rasterize_view(raw, camera)
    for name in CHANNELS:
        # Where alpha is small, a normalised channel divides rounding errors by it.
        solid, scale = expected["alpha"] > 0.02, max(1.0, np.abs(expected[name]).max())
        assert_close(image[name], expected[name], atol=tol.IMAGE_ABS * scale, where=solid, name=name)


def test_rasterize__blends_features_like_the_confidence(scene):
    """Twelve columns beside the colour have the image and the gradients of the confidence channel."""
    raw, camera = scene
    rng = np.random.default_rng(2)
    values, seed = rng.normal(size=(len(raw["means"]), 12)), rng.normal(size=(camera.height, camera.width, 12))

    def differentiated(column):
        gaussians = to_gaussians(raw, grad=True)
        if column is None:
            features = mi.TensorXf(values)
            dr.enable_grad(features)
            image = rasterize(gaussians, camera, ("color",), features=features).features
            dr.backward(dr.sum(image * mi.TensorXf(seed), axis=None))
            return np.asarray(dr.detach(image)), np.asarray(dr.grad(features)), np.asarray(dr.grad(gaussians.means))
        logits = mi.TensorXf(np.zeros(len(values)))
        dr.enable_grad(logits)
        one = replace(gaussians, logit_confidence=logits)
        image = rasterize(one, camera, ("confidence",)).confidence
        dr.backward(dr.sum(image * mi.TensorXf(seed[..., column : column + 1]), axis=None))
        return dr.grad(logits)

    image, grad, means_grad = differentiated(None)
    expected = sum(w[..., None] * v for w, v in zip(blend_weights(raw, camera), values, strict=True))
    assert_close(image, expected, atol=tol.IMAGE_ABS * np.abs(values).max())
    assert np.abs(means_grad).max() > 0
    for column in (0, 11):
        # sigmoid'(0) = 1 / 4
        assert_close(grad[:, column], 4 * np.asarray(differentiated(column)), rtol=tol.GRADIENT_REL)


def blend_weights(raw, camera):
    """Return T alpha [H, W] of every Gaussian: the confidence channel where only this one has confidence 1."""
    n = len(raw["means"])
    for k in range(n):
        logits = np.where(np.arange(n) == k, 100.0, -100.0)
        gaussians = to_gaussians({**raw, "logit_confidence": logits})
        yield np.asarray(rasterize(gaussians, camera, ("confidence",)).confidence)[..., 0]


@pytest.mark.parametrize("channel", CHANNELS)
def test_rasterize__backward_agrees_with_the_reference_for_every_attribute(scene, channel):
    raw, camera = scene
    rng = np.random.default_rng(1)
    size = {"color": 3, "motion": 2}.get(channel, 1)
    weight = rng.normal(size=(camera.height, camera.width, size)) * (rasterize_view(raw, camera)["alpha"] > 0.02)
    background = (0.2, 0.5, 0.9) if channel == "color" else None

    gaussians = to_gaussians(raw, grad=True)
    image = rasterize(gaussians, camera, (channel,), background)
    dr.backward(dr.sum(image[channel] * mi.TensorXf(np.float32(weight)), axis=None))
    expected = reference.complex_step(
        lambda values: np.sum(rasterize_view(values, camera, background)[channel] * weight), raw, list(RAW)
    )
    for name in RAW:
        found = np.asarray(dr.grad(getattr(gaussians, name)))
        assert np.isfinite(found).all()
        if np.abs(expected[name]).max() == 0:
            assert np.abs(found).max() == 0, f"{channel} must not depend on {name}"
        else:
            assert_close(found, expected[name], rtol=tol.GRADIENT_REL, name=name)


def test_rasterize__forward_mode_agrees_with_the_reference(scene):
    raw, camera = scene
    rng = np.random.default_rng(2)
    direction = {name: np.float32(rng.normal(size=raw[name].shape)).astype(np.float64) for name in RAW}
    gaussians = to_gaussians(raw, grad=True)
    image = rasterize(gaussians, camera, CHANNELS)
    for name in RAW:
        dr.set_grad(getattr(gaussians, name), mi.TensorXf(np.float32(direction[name])))
    outputs = [image[name] for name in CHANNELS]
    dr.forward_to(outputs)
    for name, output in zip(CHANNELS, outputs, strict=True):
        expected = reference.directional(lambda v, name=name: rasterize_view(v, camera)[name], raw, direction)
        solid = rasterize_view(raw, camera)["alpha"] > 0.02
        assert_close(dr.grad(output), expected, rtol=tol.GRADIENT_REL, where=solid, name=name)


def test_rasterize__forward_and_reverse_mode_are_dual(scene):
    """<g, J v> = <J' g, v> for random g and v over all channels and attributes at once."""
    raw, camera = scene
    rng = np.random.default_rng(3)
    directions = {name: np.float32(rng.normal(size=raw[name].shape)) for name in RAW}

    def loss(gaussians):
        image = rasterize(gaussians, camera, ("color", "confidence"), (0.1, 0.2, 0.3))
        return dr.sum(dr.square(image.color), axis=None) + dr.sum(dr.sin(3 * image.confidence), axis=None)

    gaussians = to_gaussians(raw, grad=True)
    dr.backward(loss(gaussians))
    reverse = sum(np.vdot(np.asarray(dr.grad(getattr(gaussians, n)), np.float64), v) for n, v in directions.items())
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
        return dr.sum(dr.square(rasterize(to_gaussians(values), camera, ("color",)).color), axis=None)

    gaussians = to_gaussians(raw, grad=True)
    dr.backward(dr.sum(dr.square(rasterize(gaussians, camera, ("color",)).color), axis=None))
    rng = np.random.default_rng(4)
    for name in RAW[:5]:
        # The direction is the sign of the gradient, so that no cancellation hides an error.
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
    dr.backward(dr.sum(image.motion, axis=None))
    assert np.abs(np.asarray(dr.grad(gaussians.motion))).max() > 0
    for name in ("log_scales", "quats", "logit_opacities", "sh_coeffs"):
        assert np.abs(np.asarray(dr.grad(getattr(gaussians, name)))).max() == 0, name


@pytest.mark.parametrize("shape", [(8, 4), (4, 4), (8, 8), (16, 2), (12, 5)])
def test_rasterize__image_does_not_depend_on_the_block_shape(scene, shape):
    raw, camera = scene
    config = RenderConfig(block_width=shape[0], block_height=shape[1])
    found = rasterize(to_gaussians(raw), camera, ("color",), config=config).color
    assert_close(found, rasterize_view(raw, camera)["color"], atol=tol.IMAGE_ABS)


def test_rasterize__stops_early_within_its_bound_in_a_dense_opaque_scene():
    """With hundreds of nearly opaque layers the lists are truncated; the image changes by at most the stop value."""
    rng = np.random.default_rng(6)
    raw = as_float32(make_scene(0, 300, seed=6))
    raw["logit_opacities"] = rng.uniform(2, 8, 300)
    raw = as_float32(raw)
    camera = make_camera(70, 45)
    found, expected = rasterize(to_gaussians(raw), camera), rasterize_view(raw, camera)
    assert expected["alpha"].max() > 1 - 1e-5
    assert_close(found.color, expected["color"], atol=tol.STOPPED_IMAGE_ABS)


def test_rasterize__backward_agrees_with_the_reference_in_a_dense_scene():
    raw = as_float32(make_scene(0, 40, seed=7))
    camera = make_camera(30, 25)
    weight = np.random.default_rng(8).normal(size=(25, 30, 3))
    gaussians = to_gaussians(raw, grad=True)
    dr.backward(dr.sum(rasterize(gaussians, camera, ("color",)).color * mi.TensorXf(np.float32(weight)), axis=None))
    names = ["means", "log_scales", "logit_opacities"]
    expected = reference.complex_step(lambda v: np.sum(rasterize_view(v, camera)["color"] * weight), raw, names)
    for name in names:
        assert_close(dr.grad(getattr(gaussians, name)), expected[name], rtol=10 * tol.GRADIENT_REL, name=name)


def test_rasterize__reproducible_gradients_have_the_same_bytes_and_values():
    raw, camera = as_float32(make_scene(1, 400, seed=9)), make_camera(120, 90)

    def gradients(config, threads):
        dr.set_thread_count(threads)
        gaussians = to_gaussians(raw, grad=True)
        image = rasterize(gaussians, camera, ("color", "alpha"), config=config)
        dr.backward(dr.sum(dr.sin(5 * image.color), axis=None) + dr.sum(image.alpha, axis=None))
        return {name: np.array(dr.grad(value)) for name, value in gaussians.items().items()}

    threads = dr.thread_count()
    try:
        runs = [gradients(RenderConfig(reproducible=True), n) for n in (threads, 1, threads, 3)]
        fast = gradients(RenderConfig(), threads)
    finally:
        dr.set_thread_count(threads)
    for name, expected in runs[0].items():
        assert all(np.array_equal(run[name], expected) for run in runs), name
        if np.abs(expected).max() > 0:
            assert_close(fast[name], expected, rtol=tol.GRADIENT_REL, name=name)


def test_rasterize__blends_equal_depths_in_the_order_of_the_input():
    raw = as_float32(make_scene(0, 2))
    raw["means"][:] = 0
    raw["quats"][:] = (1, 0, 0, 0)
    raw["sh_coeffs"][:] = np.array([1.0, -1.0])[:, None, None]
    camera = make_camera()
    found = rasterize(to_gaussians(raw), camera).color
    assert_close(found, rasterize_view(raw, camera)["color"], atol=tol.IMAGE_ABS)


def test_rasterize__of_no_gaussians_is_the_background():
    empty = Gaussians(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 1, 3)))
    image = rasterize(empty, make_camera(5, 3), background=(0.1, 0.2, 0.3))
    assert np.allclose(np.asarray(image.color), (0.1, 0.2, 0.3))
    assert np.asarray(image.alpha).max() == 0


def test_rasterize__of_gaussians_out_of_view_is_empty_with_zero_gradients(scene):
    raw, camera = scene
    behind = {**raw, "means": raw["means"] - np.array([0, 0, 50.0])}
    gaussians = to_gaussians(behind, grad=True)
    image = rasterize(gaussians, camera, CHANNELS)
    dr.backward(dr.sum(image.color, axis=None))
    for name in CHANNELS:
        assert np.asarray(image[name]).max() == 0
    assert np.abs(np.asarray(dr.grad(gaussians.means))).max() == 0


def test_rasterize__agrees_with_the_reference_in_a_one_pixel_image(scene):
    raw, _ = scene
    camera = make_camera(1, 1)
    found = rasterize(to_gaussians(raw), camera, ("color",)).color
    assert_close(found, rasterize_view(raw, camera)["color"], atol=tol.IMAGE_ABS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": np.nan}, r"`means` must be finite, got nan at \[3"),
        ({"log_scales": np.inf}, r"`scales` must be finite, got inf at \[3"),
        ({"sh_coeffs": -np.inf}, r"`sh_coeffs` must be finite, got -inf at \[3"),
        ({"quats": np.nan}, r"`quats` must be finite"),
        ({"logit_opacities": np.nan}, r"`opacities` must be finite"),
    ],
)
def test_rasterize__refuses_non_finite_attributes_by_name_and_index(scene, change, message):
    raw, camera = scene
    raw = {k: v.copy() for k, v in raw.items()}
    for name, value in change.items():
        raw[name][3] = value
    with pytest.raises(ValueError, match=message):
        rasterize(to_gaussians(raw), camera)


def test_rasterize__refuses_bad_arguments(scene):
    raw, camera = scene
    with pytest.raises(ValueError, match="`channels` must be out of color, alpha"):
        rasterize(to_gaussians(raw), camera, ("colour",))
    for background in ((1, 2), 0.5, (0, 0, np.nan)):
        with pytest.raises(ValueError, match="`background` must be three finite numbers"):
            rasterize(to_gaussians(raw), camera, background=background)
    for features in (np.ones(10), np.ones((9, 2)), np.ones((10, 13))):
        with pytest.raises(ValueError, match=r"`features` must be \[N, F\] with N=10 and F from 1 to 12"):
            rasterize(to_gaussians(raw), camera, features=features)
    broken = np.where(np.arange(10)[:, None] == 3, np.nan, np.ones((10, 2)))
    with pytest.raises(ValueError, match=r"`features` must be finite, got nan at \[3, 0\]"):
        rasterize(to_gaussians(raw), camera, features=broken)
    bare = {k: v for k, v in raw.items() if k not in ("motion", "logit_confidence")}
    for channel, attribute in (("motion", "motion"), ("confidence", "logit_confidence")):
        with pytest.raises(ValueError, match=f"channel '{channel}' requires Gaussians with `{attribute}`, got none"):
            rasterize(to_gaussians(bare), camera, (channel,))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gaussians": None}, "`gaussians` must be Gaussians, got a NoneType"),
        ({"camera": None}, "`camera` must be a .*Camera, got a NoneType"),
        ({"channels": "color"}, "`channels` must be a sequence of names, got 'color'"),
        ({"detach_weights": "color"}, "`detach_weights` must be a sequence of names"),
        ({"region": "all"}, "`region` must be a .*Region, got a str"),
        ({"static_splats": "all"}, "`static_splats` must be a .*Splats"),
        ({"config": {}}, "`config` must be a .*RenderConfig, got a dict"),
        ({"active": np.arange(10)}, r"`active` must be bool \[N\] with N=10, got int64 \[10\]"),
        ({"active": np.ones(9, bool)}, r"`active` must be bool \[N\] with N=10, got 9"),
        ({"background": "red"}, "`background` must be three finite numbers"),
        ({"features": "all"}, "`features` must be an array of real numbers"),
        ({"features": mi.Float(1)}, "`features` must be a NumPy array or a"),
    ],
)
def test_rasterize__refuses_arguments_of_another_type(scene, arguments, message):
    raw, camera = scene
    with pytest.raises(ValueError, match=message):
        rasterize(**{"gaussians": to_gaussians(raw), "camera": camera, **arguments})


@pytest.mark.parametrize("on_region", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rasterize__refuses_a_pose_that_is_not_finite(scene, value, on_region):
    raw, camera = scene
    viewmat = np.float32(camera.viewmat)
    viewmat[2, 3] = value
    posed = replace(camera, viewmat=mi.TensorXf(viewmat))
    region = Region(np.ones((camera.height, camera.width), bool)) if on_region else None
    with pytest.raises(ValueError, match=rf"`camera.viewmat` must be finite, got {value} at \[2, 3\]"):
        rasterize(to_gaussians(raw), posed, region=region)


def test_rasterize__refuses_to_be_frozen(scene):
    """Dr.Jit would end the process."""
    raw, camera = scene
    gaussians = to_gaussians(raw)
    frozen = dr.freeze(lambda means: rasterize(replace(gaussians, means=means), camera).color)
    with pytest.raises(RuntimeError) as error:
        frozen(gaussians.means)
    assert "rasterize(): expected a call outside dr.freeze" in str(error.value.__cause__)


def test_rasterize__copies_masks_and_features_before_it_returns(scene):
    raw, camera = scene
    active, features, background = np.arange(10) < 5, np.ones((10, 2), np.float32), np.full(3, 0.5)
    images = []
    for overwritten in (False, True):
        gaussians = to_gaussians(raw, grad=True)
        arguments = [array.copy() for array in (active, features, background)]
        image = rasterize(
            gaussians, camera, ("color",), active=arguments[0], features=arguments[1], background=arguments[2]
        )
        for array in arguments if overwritten else ():
            array[:] = 0
        dr.backward(dr.sum(image.color) + dr.sum(image.features))
        images.append([np.asarray(v) for v in (image.color, image.features, dr.grad(gaussians.means))])
    for before, after in zip(*images, strict=True):
        np.testing.assert_allclose(before, after, rtol=1e-5, atol=1e-5)


def test_gaussians__refuse_attributes_of_another_length(scene):
    raw, _ = scene
    with pytest.raises(ValueError, match=r"`quats` must be \[N, 4\] with N=10, got \(9, 4\)"):
        Gaussians(**{**raw, "quats": raw["quats"][:9]})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"block_width": 17}, "must be 4, 8, 12 or 16 px, got 17"),
        ({"block_width": 8.0}, "must be 4, 8, 12 or 16 px, got 8.0"),
        ({"block_height": 2.5}, "must be an integer from 1 to 16 px, got 2.5"),
        ({"block_height": 0}, "must be an integer from 1 to 16 px, got 0"),
        ({"eps2d": np.nan}, r"`eps2d` must be a number in \[0, 1e18\], got nan"),
        ({"eps2d": -1}, "`eps2d` must be a number"),
        ({"eps2d": "0.3"}, "`eps2d` must be a number"),
        ({"alpha_min": 0}, r"`alpha_min` must be a number in \(0, 0.99\)"),
        ({"alpha_min": 0.5, "alpha_max": 0.4}, r"`alpha_min` must be a number in \(0, 0.4\)"),
        ({"alpha_max": 1}, r"`alpha_max` must be a number in \(0, 1\)"),
        ({"stop_transmittance": np.inf}, r"`stop_transmittance` must be a number in \[0, 1\)"),
    ],
)
def test_render_config__refuses_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        RenderConfig(**settings)


def test_rasterize__compiles_its_kernels_once_for_all_cameras_and_sizes():
    """No camera, image size or number of Gaussians may end up as a literal in a kernel."""

    def step(gaussians, camera):
        image = rasterize(gaussians, camera, ("color",))
        dr.backward(dr.sum(image.color, axis=None))
        dr.eval(dr.grad(gaussians.means), dr.grad(gaussians.quats))
        dr.sync_thread()

    small, large = (to_gaussians(make_scene(0, n, seed=n), grad=True) for n in (40, 70))
    step(small, make_camera(50, 41))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        step(large, make_camera(90, 61))
        compiled = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and not k["cache_hit"]]
    assert not compiled


# --------------------------------------------------------------------------------------------------
#  A new attribute of the table
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def new_attributes(monkeypatch):
    """Add two rows to the table of attributes."""
    for attribute in NEW_ATTRIBUTES:
        monkeypatch.setitem(BY_ACTIVATED_NAME, attribute.activated_name, attribute)


@pytest.mark.usefixtures("new_attributes")
def test_rasterize__renders_a_new_attribute_of_the_table(scene):
    raw, camera = scene
    rng = np.random.default_rng(6)
    normals = np.float32(rng.normal(size=(len(raw["means"]), 3)))
    gaussians = ExtendedGaussians(**raw, logit_roughness=raw["logit_confidence"], normals=normals)
    dr.enable_grad(gaussians.logit_confidence, gaussians.logit_roughness)
    channels = ("color", "roughness", "confidence", "normal")
    image = rasterize(gaussians, camera, channels, features=normals)
    assert image["color"].shape == (camera.height, camera.width, 3)
    assert_close(image["roughness"], image.confidence)
    assert_close(image["normal"], image.features)
    dr.backward(dr.sum(dr.square(image["roughness"]), axis=None) + dr.sum(dr.square(image.confidence), axis=None))
    grad = np.asarray(dr.grad(gaussians.logit_confidence))
    assert np.abs(grad).max() > 0
    assert_close(dr.grad(gaussians.logit_roughness), grad, rtol=tol.SUM_ORDER_REL)
    with pytest.raises(ValueError, match="channel 'roughness' requires Gaussians with `logit_roughness`, got none"):
        rasterize(to_gaussians(raw), camera, ("roughness",))
    broken = replace(gaussians, normals=np.where(np.arange(30).reshape(10, 3) == 7, np.nan, normals))
    with pytest.raises(ValueError, match=r"`normals` must be finite, got nan at \[2, 1\]"):
        rasterize(broken, camera, ("normal",))


@pytest.mark.usefixtures("new_attributes")
def test_rasterize__renders_on_a_region_a_new_attribute_of_the_table(scene):
    raw, camera = scene
    gaussians = ExtendedGaussians(**raw, logit_roughness=raw["logit_confidence"])
    mask = np.zeros((camera.height, camera.width), bool)
    mask[9, 10] = True
    region, active = Region(mask), np.arange(len(raw["means"])) % 2 == 0
    image = rasterize(gaussians, camera, ("roughness", "confidence"), region=region, active=active)
    assert_close(image["roughness"], image.confidence)


def test_image__is_indexed_by_channel(scene):
    raw, camera = scene
    image = rasterize(to_gaussians(raw), camera, ("color", "depth"))
    assert image["color"] is image.color
    assert image["depth"] is image.depth
    with pytest.raises(KeyError, match="expected a channel out of color, depth, got 'alpha'"):
        image["alpha"]

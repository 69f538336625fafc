"""Gaussians among surfaces: closed forms of the image, its derivatives, and bad scenes."""

import logging

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Gaussians, rasterize
from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import isotropic
from tests.scenes.surfaces import (
    COLOR,
    LAMP,
    LIT,
    camera,
    cloud,
    glowing,
    lit_scene,
    render,
    scene,
    slopes_of,
    slopes_of_both_modes,
    wall,
)


def splats(gaussians):
    """Return the display-referred colour and the transmittance of Gaussians alone."""
    image = rasterize(gaussians, camera())
    return np.asarray(image.color, np.float64), 1 - np.asarray(image.alpha, np.float64)


def over(gaussians, linear):
    """Return Gaussians over linear light, blended display-referred, as linear light."""
    color, transmittance = splats(gaussians)
    return decode_light(color + transmittance * encode_light(np.asarray(linear)))


@pytest.mark.slow
def test_surfaces__alone_keep_their_antialiased_outline():
    """Where there are no splats, the image is the nested integrator's, also in pixels that it
    covers in part.
    """
    shapes = {
        "ball": {"type": "sphere", "center": [0, 0, 0], "radius": 0.7},
        "sky": {"type": "constant", "radiance": 0.4},
    }
    expected = mi.load_dict(
        {"type": "scene", "sensor": camera().sensor(), "integrator": {"type": "path"}, **shapes}
    )
    scene_with_splats = scene(isotropic([(0, 0, -90)], 0.1, 0.5), {"type": "path"}, **shapes)
    assert_close(render(scene_with_splats, seed=1), render(expected, seed=1), atol=tol.IMAGE_ABS)


@pytest.mark.slow
def test_surfaces__behind_show_through_the_splats():
    gaussians = cloud(0.0)
    assert_close(
        render(scene(gaussians, wall=wall(1, **glowing()))),
        over(gaussians, COLOR),
        atol=tol.IMAGE_ABS,
    )
    black = {"bsdf": {"type": "diffuse", "reflectance": 0.0}}
    image = render(scene(gaussians, wall=wall(1, **black), lamp=LAMP))
    assert_close(image, decode_light(splats(gaussians)[0]), atol=tol.IMAGE_ABS)


def test_surfaces__around_the_camera_are_behind_all_splats():
    """A part of their bounding box is behind the camera."""
    gaussians = cloud(0.0)
    room = {"type": "sphere", "radius": 20.0, "flip_normals": True, **glowing()}
    assert_close(render(scene(gaussians, room=room)), over(gaussians, COLOR), atol=tol.IMAGE_ABS)


def test_surfaces__between_splats_hide_those_behind():
    near = cloud(-0.5, seed=1)
    far = cloud(0.5, seed=2)
    image = render(scene(Gaussians.concatenate([near, far]), wall=wall(0, **glowing())))
    assert_close(image, over(near, COLOR), atol=tol.IMAGE_ABS)


def test_surfaces__blend_linear_splats_in_linear_light():
    gaussians = cloud(0.0)
    image = render(scene(gaussians, wall=wall(1, **glowing()), props={"srgb_primitives": False}))
    color, transmittance = splats(gaussians)
    assert_close(image, color + transmittance * COLOR, atol=tol.IMAGE_ABS)


def test_surfaces__white_splats_around_a_white_ball_in_white_light_are_a_furnace():
    white = isotropic(
        np.random.default_rng(0).uniform(-1.5, 1.5, (80, 3)), 0.15, 0.6, 0.5 / 0.28209479177387814
    )
    ball = {"type": "sphere", "radius": 0.8, "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    # Rays by the material alone, without noise.
    integrator = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
    image = render(scene(white, integrator, ball=ball, sky={"type": "constant", "radiance": 1.0}))
    assert_close(image, 1, atol=tol.IMAGE_ABS)


def test_surfaces__background_is_behind_all():
    gaussians = cloud(0.0)
    background = (0.1, 0.4, 0.8)
    image = render(
        scene(gaussians, card=wall(1, 0.5, **glowing()), props={"background": list(background)})
    )
    expected = over(gaussians, decode_light(np.array(background)))
    outside = np.hypot(*np.meshgrid(np.arange(32) - 15.5, np.arange(24) - 11.5)) > 10
    assert_close(image, expected, atol=tol.IMAGE_ABS, where=outside[..., None])


def test_surfaces__channels_include_them():
    props = {"aovs": "depth,confidence"}
    near = cloud(-0.5)
    both = Gaussians.concatenate([near, cloud(0.5)])
    both = Gaussians(**both.numpy(), logit_confidence=np.full(len(both), 9.0))
    image = render(
        scene(both, film={"pixel_format": "rgba"}, wall=wall(0, **glowing()), props=props)
    )
    alone = rasterize(near, camera(), ("alpha", "depth"))
    alpha, depth = (np.asarray(v, np.float64)[..., 0] for v in (alone.alpha, alone.depth))
    assert_close(image[..., 3], 1, atol=tol.IMAGE_ABS)
    assert_close(image[..., 4], alpha * depth + (1 - alpha) * 4, atol=1e-4)
    assert_close(image[..., 5], alpha / (1 + np.exp(-9)), atol=tol.IMAGE_ABS)


@pytest.mark.slow
def test_surfaces__crop_equals_that_of_the_full_image():
    shapes = {"ball": {"type": "sphere", "radius": 0.7, **glowing()}}
    full = render(scene(cloud(0.0), **shapes), spp=256)
    crop = {"crop_offset_x": 8, "crop_offset_y": 6, "crop_width": 13, "crop_height": 9}
    # The samples differ: noise in the pixels of the outline.
    assert_close(
        render(scene(cloud(0.0), film=crop, **shapes), spp=256), full[6:15, 8:21], atol=0.06
    )


def test_surfaces__of_an_environment_alone_are_its_light():
    gaussians = cloud(0.0)
    image = render(scene(gaussians, sky={"type": "constant", "radiance": 0.3}))
    assert_close(image, over(gaussians, 0.3), atol=tol.IMAGE_ABS)


def test_surfaces__leave_the_whole_scene_as_it_is():
    """Its parameters keep their names, and its environment its extent."""
    whole = scene(cloud(), ball={"type": "sphere"}, sky={"type": "constant"}, wall=wall(90))
    it = dr.zeros(mi.Interaction3f)
    names = list(mi.traverse(whole).keys())

    def distance():
        return float(whole.environment().sample_direction(it, mi.Point2f(0.5))[0].dist[0])

    old_distance = distance()
    render(whole, spp=1)
    assert distance() == old_distance > 90
    assert list(mi.traverse(whole).keys()) == names


# --------------------------------------------------------------------------------------------------
#  Derivatives
# --------------------------------------------------------------------------------------------------

# A lit wall through the splats, and a ball that emits light among them.
DIFFERENTIATED = {
    "gaussians.data": 1e-3,
    "gaussians.opacities": 1e-3,
    "gaussians.sh_coeffs": 1e-3,
    **LIT,
}


@pytest.fixture(scope="module")
def differentiated():
    # No two depths are equal: their order would change with the parameters.
    gaussians = Gaussians.concatenate(
        [cloud(z, 1, seed) for seed, z in enumerate(np.linspace(-0.8, 0.6, 40))]
    )
    return lit_scene(gaussians, "prb", 0.05, **glowing())


@pytest.fixture(scope="module")
def target(differentiated):
    return mi.TensorXf(np.float32(np.random.default_rng(0).uniform(size=(24, 32, 3))))


def loss(image, target):
    return dr.mean(dr.square(image - target), axis=None)


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_surfaces__backward_agrees_with_central_differences(differentiated, target, name):
    gradient, difference = slopes_of(
        differentiated, name, DIFFERENTIATED[name], lambda image: loss(image, target), 64
    )
    assert difference == pytest.approx(gradient, rel=2 * tol.CENTRAL_DIFFERENCE_REL)


@pytest.mark.slow
def test_surfaces__forward_mode_is_dual_to_reverse_mode(differentiated, target):
    reverse, forward = slopes_of_both_modes(differentiated, DIFFERENTIATED, target)
    assert forward == pytest.approx(reverse, rel=1e-2)


@pytest.mark.slow
def test_surfaces__gradients_of_positions_warn(target, caplog):
    card = scene(cloud(0.0), "prb", card=wall(0.5, **glowing()))
    params = mi.traverse(card)
    dr.enable_grad(params["card.to_world"])
    params.update()
    with caplog.at_level(logging.WARNING, logger="morgs_mi"):
        dr.backward(loss(mi.render(card, params, spp=1), target))
    assert "lack what changes with their silhouettes" in caplog.text
    assert "`card.to_world`" in caplog.text


# --------------------------------------------------------------------------------------------------
#  Bad scenes
# --------------------------------------------------------------------------------------------------


FOG = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (
            {"ball": {"type": "sphere"}},
            "expected an emitter that lights the surfaces, got none",
        ),
        (
            {"ball": {"type": "sphere", "interior": FOG}, "lamp": LAMP},
            "Sphere 'ball', the boundary of a medium",
        ),
    ],
)
def test_surfaces__refuse_bad_scenes(shapes, message):
    bad = scene(cloud(), **shapes)
    with pytest.raises(ValueError, match=message):
        bad.integrator().render(bad)


def test_surfaces__forward_mode_leaves_the_gaussians_attached():
    gaussians = cloud(-0.5)
    ball = {"type": "sphere", "radius": 0.8}
    light = {"type": "constant", "radiance": 1.0}
    made = scene(gaussians, {"type": "prb"}, ball=ball, sky=light)
    params = mi.traverse(made)
    names = ("gaussians.opacities", "ball.bsdf.reflectance.value")
    dr.enable_grad([params[name] for name in names])
    dr.set_grad(params[names[1]], 1)
    dr.forward_to(mi.render(made, params, spp=4))
    assert all(dr.grad_enabled(params[name]) for name in names)
    backward(mi.render(made, params, spp=4))
    assert np.abs(np.asarray(dr.grad(params[names[0]]))).max() > 0


def test_surfaces__before_an_environment_with_gradients_warn_of_nothing(caplog):
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}
    ball = {"type": "sphere", "radius": 0.8}
    made = scene(cloud(-0.5), {"type": "prb"}, ball=ball, sky=sky)
    params = mi.traverse(made)
    brightness = mi.Float(1)
    dr.enable_grad(brightness)
    params["sky.data"] = params["sky.data"] * brightness
    params.update()
    backward(mi.render(made, params, spp=4))
    assert dr.grad(brightness)[0] > 0
    assert "silhouettes" not in caplog.text

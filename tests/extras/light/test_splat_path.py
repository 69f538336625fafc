"""`splat_path`: closed forms of the shadows, reflections and light of Gaussians, derivatives, and
bad input.
"""

import logging

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import RenderConfig, rasterize
from morgs_mi.core.color_space import SH_C0, decode_light
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.testing import assert_close
from tests.scenes.gaussians import isotropic
from tests.scenes.surfaces import (
    LAMP,
    LIT,
    camera,
    cloud,
    glowing,
    lit_scene,
    mirrored,
    render,
    scene,
    slopes_of,
    slopes_of_both_modes,
    wall,
)

# Light that falls on the middle of the wall at z = 1 from a place that the camera does not see.
ASIDE = np.array([3.0, 0, -1])
TO_WALL = np.array([-3.0, 0, 2]) / np.sqrt(13)
SUN = {"type": "directional", "direction": TO_WALL.tolist(), "irradiance": 2.0}
TRACED = {"type": "splat_path", "max_depth": 2, "clipped": 1.0}
WHITE = 0.5 / SH_C0
BLACK = -0.5 / SH_C0
DARK = {"type": "constant", "radiance": 0.0}


FAR = isotropic([(0, 0, -90)], 0.1, 0.5)


def ratio(gaussians, integrator=TRACED, spp=128, **more):
    """Return the image of the lit wall with Gaussians beside the view, over that without them."""
    lit = {"wall": wall(1), "sun": SUN}
    light = render(scene(gaussians, integrator, **lit, **more), spp=spp)
    return (light / render(scene(FAR, integrator, **lit), spp=spp))[..., 0]


def distance_to_aside():
    """Return the distance [H, W] of ASIDE from the light that falls on the wall at each pixel."""
    view = camera()
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    points = view.unproject(np.stack([x, y], axis=-1), np.full(x.shape, 5.0))
    return np.linalg.norm(np.cross(points - ASIDE, TO_WALL), axis=-1)


# --------------------------------------------------------------------------------------------------
#  Shadows
# --------------------------------------------------------------------------------------------------


def test_splat_path__shadow_of_one_gaussian_is_its_transmittance():
    shadow = ratio(isotropic([ASIDE], 0.3, 0.8, BLACK))
    alpha = 0.8 * np.exp(-0.5 * (distance_to_aside() / 0.3) ** 2)
    assert shadow.min() < 0.25
    assert_close(shadow, 1 - np.where(alpha < 1 / 255, 0, alpha), atol=0.02)


@pytest.mark.slow
def test_splat_path__shadows_have_the_cut_off_of_the_plugin():
    image = ratio(isotropic([ASIDE], 0.3, 0.8, BLACK), props={"alpha_min": 0.5})
    alpha = 0.8 * np.exp(-0.5 * (distance_to_aside() / 0.3) ** 2)
    clear = np.abs(alpha - 0.5) > 0.15  # in other pixels, a part of the rays is above the cut-off
    assert ((alpha > 0.1) & (alpha < 0.35)).any()
    assert_close(image[clear], np.where(alpha < 0.5, 1, 1 - alpha)[clear], atol=0.03)


def test_splat_path__shadow_of_a_point_light_ends_at_the_light():
    """Gaussians behind the light cast no shadow; one that is cut by the light's position casts half
    its depth.
    """
    bulb = {"type": "point", "position": ASIDE.tolist(), "intensity": 9.0}
    behind, cut = (isotropic([at], 0.3, 0.75, BLACK) for at in (ASIDE - 2 * TO_WALL, ASIDE))
    images = [
        render(scene(each, TRACED, wall=wall(1), bulb=bulb), spp=1) for each in (behind, cut, FAR)
    ]
    assert_close(images[0], images[2], atol=1e-5)
    assert_close((images[1] / images[2])[12, 16], 0.5, atol=1e-3)


# --------------------------------------------------------------------------------------------------
#  Reflections
# --------------------------------------------------------------------------------------------------


def light_of(gaussians, view, srgb=True):
    """Return the premultiplied linear light of Gaussians in a view.

    A pixel averages over a square of variance 1 / 12 px^2 in each direction.
    """
    images = rasterize(gaussians, view, ("color", "alpha"), config=RenderConfig(eps2d=1 / 12))
    color, alpha = (np.asarray(value, np.float64) for value in (images.color, images.alpha))
    return alpha * decode_light(color / np.maximum(alpha, 1e-6)) if srgb else color


@pytest.mark.slow
@pytest.mark.parametrize("srgb", [True, False])
def test_splat_path__mirror_shows_the_view_of_the_mirrored_camera(srgb):
    gaussians, view, image_of_view, mirror = mirrored(0.8, 0.8, 60)
    props = {"srgb_primitives": srgb}
    image = render(
        scene(gaussians, TRACED, view=view, mirror=mirror, dark=DARK, props=props), spp=64
    )
    assert psnr(image, light_of(gaussians, image_of_view, srgb)[:, ::-1]) > 36


def test_splat_path__glass_without_refraction_shows_what_is_behind_it():
    behind = cloud(1.0)
    pane = wall(0, bsdf={"type": "dielectric", "int_ior": 1.0001, "ext_ior": 1.0})
    image = render(scene(behind, {**TRACED, "max_depth": 4}, pane=pane, dark=DARK), spp=256)
    assert psnr(image, light_of(behind, camera())) > 35


def test_splat_path__camera_sees_the_splats_in_front_of_surfaces_as_before():
    """Gaussians between the camera and a glowing wall are blended by the rasteriser alone."""
    images = [
        render(scene(cloud(0.0), kind, wall=wall(1, **glowing())), spp=4)
        for kind in (TRACED, "path")
    ]
    assert_close(images[0], images[1], atol=1e-5)


def test_splat_path__clipped_colours_are_brighter_than_white():
    """An opaque white shell lights a white ball inside it with the radiance of what was clipped."""
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    shell = isotropic(
        6 * directions / np.linalg.norm(directions, axis=1, keepdims=True), 0.5, 0.98, WHITE
    )
    ball = {"type": "sphere", "radius": 0.8, "bsdf": {"type": "conductor", "material": "none"}}
    image = render(scene(shell, {**TRACED, "clipped": 3.0}, ball=ball, dark=DARK), spp=4)
    assert image[12, 16, 0] == pytest.approx(3, abs=0.01)


def test_splat_path__white_splats_around_a_white_ball_in_white_light_are_a_furnace():
    white = isotropic(np.random.default_rng(0).uniform(-1.5, 1.5, (80, 3)), 0.15, 0.6, WHITE)
    ball = {"type": "sphere", "radius": 0.8, "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    endless = {**TRACED, "max_depth": -1, "rr_depth": 100}
    image = render(
        scene(white, endless, ball=ball, sky={"type": "constant", "radiance": 1.0}), spp=128
    )
    assert image.mean() == pytest.approx(1, abs=1e-3)
    assert_close(image, 1, atol=0.06)


# --------------------------------------------------------------------------------------------------
#  Derivatives
# --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def differentiated():
    ball = {"bsdf": {"type": "diffuse"}, "emitter": {"type": "area", "radiance": 0.7}}
    return lit_scene(cloud(-0.2), {**TRACED, "max_depth": 4}, 0.5, **ball)


# A linear loss: noise in the image biases neither its derivative nor differences.
WEIGHTS = np.float32(np.random.default_rng(0).uniform(size=(24, 32, 3)))


def loss(image):
    return dr.mean(image * mi.TensorXf(WEIGHTS), axis=None)


@pytest.mark.slow
@pytest.mark.parametrize("name", LIT)
def test_splat_path__gradients_agree_with_central_differences(differentiated, name):
    gradient, difference = slopes_of(differentiated, name, LIT[name], loss, 128)
    assert gradient == pytest.approx(difference, rel=3e-2)


@pytest.mark.slow
def test_splat_path__forward_mode_is_dual_to_reverse_mode(differentiated):
    reverse, forward = slopes_of_both_modes(differentiated, LIT, mi.TensorXf(WEIGHTS))
    assert forward == pytest.approx(reverse, rel=1e-2)


def test_splat_path__gradients_of_gaussians_warn(caplog):
    whole = scene(cloud(-0.2), TRACED, wall=wall(0.5), lamp=LAMP)
    params = mi.traverse(whole)
    dr.enable_grad(params["gaussians.sh_coeffs"])
    params.update()
    with caplog.at_level(logging.WARNING, logger="morgs_mi"):
        dr.backward(loss(mi.render(whole, params, spp=1)))
    assert "they lack what the Gaussians send to the surfaces" in caplog.text
    assert (np.array(dr.grad(params["gaussians.sh_coeffs"])) != 0).any()


# --------------------------------------------------------------------------------------------------
#  Bad input
# --------------------------------------------------------------------------------------------------


def test_splat_path__refuses_scenes_without_a_gaussian_splat_integrator():
    alone = mi.load_dict(
        {"type": "scene", "integrator": TRACED, "ball": {"type": "sphere"}, "lamp": LAMP}
    )
    with pytest.raises(ValueError, match="splat_path: expected Gaussians, got none"):
        alone.integrator().render(alone, mi.load_dict(camera().sensor()))


def test_splat_path__refuses_a_radiance_below_white():
    with pytest.raises(RuntimeError, match="`clipped` must be at least 1"):
        mi.load_dict({"type": "splat_path", "clipped": 0.5})

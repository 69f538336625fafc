"""`shadow_ratio` and `shadowed`: closed forms, and bad input."""

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import Camera, Gaussians, rasterize, shadow_ratio, shadowed
from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.testing import assert_close
from tests.scenes.gaussians import isotropic

EYE = (0, 3, 0)
SUN = {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": 2.0}
SKY = {"type": "constant", "radiance": 1.0}
BULB = {"type": "point", "position": [0, 2, 0], "intensity": 1.0}


def floor(positions, up=True):
    """Return thin discs at positions (x, z) [M, 2] of the plane y = 0, with either sign of their
    axis.
    """
    n = len(positions)
    means = np.stack([positions[:, 0], np.zeros(n), positions[:, 1]], axis=1)
    quats = np.tile([1.0, 0, 0, 0] if up else [0.0, 1, 0, 0], (n, 1))
    return Gaussians.from_activated(
        means, np.tile([0.1, 1e-9, 0.1], (n, 1)), quats, np.full(n, 0.9), np.zeros((n, 1, 3))
    )


def disk(height, radius=0.5):
    """Return a horizontal disk above the origin."""
    transform = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], 90).scale(radius)
    return {"type": "disk", "to_world": transform}


def scene(**entries):
    return mi.load_dict({"type": "scene", **entries})


def test_shadow_ratio__of_a_directional_light_is_the_projected_outline():
    positions = np.stack([np.linspace(-1, 1, 81), np.zeros(81)], axis=1)
    ratios = shadow_ratio(floor(positions), scene(sun=SUN, disk=disk(1.0)), EYE, 4)
    # Light that passes (x, 0, z) was at (x - 0.3, 1, z - 0.2).
    mask = np.hypot(positions[:, 0] - 0.3, positions[:, 1] - 0.2) < 0.5
    assert_array_equal(ratios, ~mask)


@pytest.mark.parametrize("up", [True, False])
def test_shadow_ratio__under_a_disk_in_a_uniform_sky_is_its_form_factor(up):
    """A disk of radius r at height h above the point takes r^2 / (r^2 + h^2) of the irradiance of
    the hemisphere.
    """
    heights = (0.25, 0.5, 1.0)
    ratios = [
        shadow_ratio(floor(np.zeros((1, 2)), up), scene(sky=SKY, disk=disk(h)), EYE, 4096)[0]
        for h in heights
    ]
    assert_close(np.array(ratios), 1 - 0.25 / (0.25 + np.square(heights)), atol=6e-3)


def test_shadow_ratio__of_a_round_gaussian_is_the_solid_angle():
    ball = isotropic([(0, 0, 0)], 0.1, 0.9)
    ratios = shadow_ratio(ball, scene(sky=SKY, disk=disk(0.5)), EYE, 4096)
    assert ratios[0] == pytest.approx(1 - 0.5 * (1 - np.sqrt(0.5)), abs=4e-3)


def test_shadow_ratio__weighs_lights_by_their_irradiance():
    """A point light of intensity 1 at height 2 gives 1/4, the sky pi; the disk hides the light and
    some sky.
    """
    ratios = shadow_ratio(
        floor(np.zeros((1, 2))), scene(bulb=BULB, sky=SKY, disk=disk(1.0, 0.05)), EYE, 4096
    )
    sky = np.pi * (1 - 0.0025 / 1.0025)
    assert ratios[0] == pytest.approx(sky / (np.pi + 0.25), abs=2e-3)


def test_shadow_ratio__of_an_area_light_is_the_hidden_part_of_it():
    """A disk at half the height of a small lamp hides that part of it which it covers, seen from
    the floor.
    """
    down = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    up = mi.ScalarTransform4f().translate([0, 2, 0]) @ down.scale([0.1, 0.1, 1])
    lamp = {"type": "rectangle", "to_world": up, "emitter": {"type": "area", "radiance": 1.0}}
    edge = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([1, 1, 0]) @ down}
    positions = np.array([[0.0, 0], [-0.05, 0], [-1, 0], [1, 0]])
    ratios = shadow_ratio(floor(positions), scene(lamp=lamp, edge=edge), EYE, 4096)
    # From x, the edge at x = 0 is seen on the lamp at -x.
    assert_close(ratios, np.array([0.5, 0.75, 1, 0]), atol=0.01)


def test_shadow_ratio__ends_at_the_light():
    behind = {"type": "sphere", "center": [0, 4, 0], "radius": 1.0}
    assert shadow_ratio(floor(np.zeros((1, 2))), scene(bulb=BULB, ball=behind), EYE)[0] == 1


def test_shadowed__scales_the_linear_light_of_an_image():
    rng = np.random.default_rng(1)
    wall = isotropic([(0, 0, 0)], 20.0, 0.98, rng.uniform(-1, 1, (1, 1, 3)))
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 40, 16, 12)
    light, shadowed_light = (
        np.asarray(rasterize(gaussians, camera, ("color", "alpha")).color, np.float64)
        for gaussians in (wall, shadowed(wall, np.array([0.3])))
    )
    assert_close(shadowed_light / 0.98, encode_light(0.3 * decode_light(light / 0.98)), atol=1e-4)


def test_shadowed__scales_all_directions_alike_and_one_changes_nothing():
    coeffs = np.random.default_rng(2).normal(size=(3, 9, 3)) * 0.1
    gaussians = isotropic(np.zeros((3, 3)), 0.1, 0.9, coeffs)
    assert_close(shadowed(gaussians, np.ones(3)).sh_coeffs, coeffs, atol=1e-6)
    ratios = (np.asarray(shadowed(gaussians, np.full(3, 0.5)).sh_coeffs) / coeffs)[:, 1:]
    assert np.ptp(ratios, axis=1).max() < 2e-3
    assert ratios.min() > 0.7
    assert ratios.max() < 0.8


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda g: shadow_ratio(g, scene(disk=disk(1)), EYE),
            "expected a scene with an emitter, got none",
        ),
        (lambda g: shadow_ratio(g, scene(sky=SKY), (0, 0)), r"`viewpoint` must be \[3\]"),
        (lambda g: shadow_ratio(g, scene(sky=SKY), EYE, 0), "`samples` must be"),
        (lambda g: shadow_ratio("g", scene(sky=SKY), EYE), "`gaussians` must be"),
        (lambda g: shadowed(g, np.ones(2)), r"`ratio` must be \[N\] with N=1"),
        (lambda g: shadowed(g, np.array([-1.0])), "not negative"),
    ],
)
def test_shadow_ratio__refuses_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call(floor(np.zeros((1, 2))))

"""`light_probe`: directions, radiance, a plane mirror, bad input."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import light_probe
from morgs_mi.core.color_space import SH_C0, decode_light
from morgs_mi.testing import assert_close
from tests.scenes.gaussians import isotropic

CENTER = np.array([0.3, -0.2, 0.1])


def radiance(probe, directions):
    """Return the radiance of an environment map in directions [M, 3]."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -mi.Vector3f(np.float32(directions.T))
    return np.array(mi.load_dict(probe).eval(si)).T


def shell(color=0.0, n=2000):
    """Return opaque Gaussians on a sphere around CENTER; colour 0.5 + SH_C0 `color`."""
    directions = np.random.default_rng(0).normal(size=(n, 3))
    means = CENTER + 3 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return isotropic(means, 0.3, 0.99, color)


def test_light_probe__shows_every_direction_where_it_is():
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    axes = np.concatenate([np.eye(3), -np.eye(3), corners / np.sqrt(3)])
    colors = np.random.default_rng(1).uniform(0.1, 0.9, (len(axes), 3))
    lamps = isotropic(CENTER + 5 * axes, 0.6, 0.99, ((colors - 0.5) / SH_C0)[:, None])
    probe = light_probe(lamps, CENTER)
    assert_close(radiance(probe, axes), decode_light(0.99 * colors), atol=0.02)


@pytest.mark.parametrize(("clipped", "atol"), [(8.0, 0.05), (1.0, 0.01)])
def test_light_probe__assigns_a_radiance_to_what_is_clipped(clipped, atol):
    probe = light_probe(shell(0.5 / SH_C0), CENTER, height=32, clipped=clipped)
    directions = np.random.default_rng(2).normal(size=(100, 3))
    assert_close(radiance(probe, directions), clipped, atol=atol)


def test_light_probe__leaves_out_what_is_near_and_shows_the_background():
    near = isotropic([CENTER + np.array([0, 0, 0.2])], 0.05, 0.9)
    probe = light_probe(near, CENTER, height=16, background=(0.5, 0.5, 0.5), near=0.5)
    assert_close(np.array(probe["bitmap"]), decode_light(np.array(0.5)), atol=1e-5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"position": (0, 0)}, r"`position` must be \[3\] and finite, got \[0.0, 0.0\]"),
        ({"height": 1}, r"`height` must be a number in \[4, 8192\]"),
        ({"clipped": 0.5}, "`clipped` must be"),
        ({"near": 0.0}, "`near` must be"),
    ],
)
def test_light_probe__refuses_bad_input(values, message):
    with pytest.raises(ValueError, match=message):
        light_probe(shell(n=5), **{"position": (0, 0, 0), **values})

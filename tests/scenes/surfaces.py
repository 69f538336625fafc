"""Mitsuba scenes of Gaussians among surfaces, seen along +z from z = -4."""

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi import Camera, ellipsoids
from tests.scenes.cameras import look_at_cameras
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import isotropic

COLOR = (0.6, 0.3, 0.1)


def camera(width=32, height=24, fov=45.0):
    """Return the camera of these scenes."""
    return look_at_cameras([(0, 0, -4)], fov, width, height)[0]


def cloud(z=0.0, n=40, seed=3, opacity=0.7):
    """Return small Gaussians of random colours in a square at depth z."""
    rng = np.random.default_rng(seed)
    means = np.stack([*rng.uniform(-1.2, 1.2, (2, n)), np.full(n, z)], axis=1)
    return isotropic(means, 0.1, opacity, rng.uniform(-1, 1, (n, 1, 3)))


def wall(z, size=5.0, **entries):
    """Return a square of half width `size` at depth z that faces the camera."""
    transform = mi.ScalarTransform4f().translate([0, 0, z]).rotate([0, 1, 0], 180).scale(size)
    return {
        "type": "rectangle",
        "to_world": transform,
        **(entries or {"bsdf": {"type": "diffuse"}}),
    }


def glowing(color=COLOR):
    """Return the entries of a black shape that emits linear light of a colour, without noise."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(color)}}
    return {"bsdf": {"type": "diffuse", "reflectance": 0.0}, "emitter": emitter}


def mirrored(color, opacity, n):
    """Return n Gaussians behind a camera, the camera, its mirror image, and the mirror at z = 0.

    Coefficients have the standard deviations `color` in degree 0 and 0.1 in degree 1.
    """
    rng = np.random.default_rng(3)
    means = np.stack([*rng.uniform(-1.5, 1.5, (2, n)), rng.uniform(-6, -5, n)], axis=1)
    deviations = np.array([color, 0.1, 0.1, 0.1])[:, None]
    gaussians = isotropic(means, 0.4, opacity, rng.normal(size=(n, 4, 3)) * deviations)
    view, image = (Camera.look_at((0, 0, z), (0, 0, 0), (0, -1, 0), 40, 48, 36) for z in (-3, 3))
    mirror = wall(0, 4, bsdf={"type": "conductor", "material": "none"})
    return gaussians, view, image, mirror


def lit_scene(gaussians, integrator, z, **ball):
    """Return a scene of Gaussians before a board at depth z, and of a ball that emits light among
    them, under a lamp and the sky; `ball` has its material and emitter.
    """
    reflectance = {"type": "rgb", "value": [0.3, 0.6, 0.5]}
    return scene(
        gaussians,
        integrator,
        wall=wall(z, 2, bsdf={"type": "diffuse", "reflectance": reflectance}),
        ball={"type": "sphere", "center": [0.4, 0.3, -0.4], "radius": 0.4, **ball},
        lamp=LAMP,
        sky={"type": "constant", "radiance": 0.2},
    )


# Parameters of a `lit_scene` with the steps of central differences.
LIT = {
    "wall.bsdf.reflectance.value": 1e-2,
    "ball.emitter.radiance.value": 1e-2,
    "lamp.intensity.value": 1e-1,
    "sky.radiance.value": 1e-2,
}
LAMP = {
    "type": "point",
    "position": [1.0, -2.0, -3.0],
    "intensity": {"type": "rgb", "value": [20.0, 18.0, 16.0]},
}


def scene(gaussians, surfaces="path", film=None, view=None, **more):
    """Return the scene of Gaussians and `more`, with the plugin's nested integrator `surfaces`, and
    its `props`.
    """
    props = more.pop("props", {})
    nested = {"type": surfaces, "max_depth": 2} if isinstance(surfaces, str) else surfaces
    return mi.load_dict(
        {
            "type": "scene",
            "gaussians": ellipsoids(gaussians),
            "sensor": (view or camera()).sensor(**(film or {})),
            "integrator": {"type": "gaussian_splat", "surfaces": nested, **props},
            **more,
        }
    )


def render(scene, spp=4, **more):
    """Return the image of a scene in float64."""
    return np.asarray(mi.render(scene, spp=spp, **more), np.float64)


def slopes_of(scene, name, step, loss, spp):
    """Return the slope of a loss of the image along a parameter, by its gradient and by central
    differences.

    The direction is that in which every entry raises the loss, by a random length.
    """
    params = mi.traverse(scene)
    start = dr.detach(params[name])
    dr.enable_grad(params[name])
    params.update()
    dr.backward(loss(mi.render(scene, params, spp=spp, seed=1, seed_grad=2)))
    gradient = np.array(dr.grad(params[name]), np.float64)
    losses = []
    direction = np.sign(gradient) * np.random.default_rng(4).uniform(0.5, 1, gradient.shape)
    for length in (step, -step):
        params[name] = start + type(start)(np.float32(length * direction))
        params.update()
        losses.append(np.asarray(loss(mi.render(scene, spp=spp, seed=1))).item())
    params[name] = start
    params.update()
    return float(np.vdot(gradient, direction)), (losses[0] - losses[1]) / (2 * step)


def slopes_of_both_modes(scene, names, weights, spp=64):
    """Return the slope of the weighted sum of the image along all parameters, in reverse and in
    forward mode.
    """
    params = mi.traverse(scene)
    slopes = []
    for forward in (False, True):
        for name in names:
            params[name] = dr.detach(params[name])
            dr.enable_grad(params[name])
        params.update()
        image = mi.render(scene, params, spp=spp, seed=1, seed_grad=2)
        if forward:
            for name in names:
                dr.set_grad(params[name], 1)
            dr.forward_to(image)
            slopes.append(float(np.vdot(np.array(dr.grad(image), np.float64), np.array(weights))))
        else:
            backward(image * weights)
            slopes.append(sum(np.array(dr.grad(params[name]), np.float64).sum() for name in names))
    for name in names:
        params[name] = dr.detach(params[name])
    params.update()
    return slopes[0], slopes[1]

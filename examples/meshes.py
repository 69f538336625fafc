"""Render Gaussians among meshes, lit by the Gaussians: python examples/meshes.py meshes.png."""

import sys

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import morgs_mi
from morgs_mi.core.color_space import encode_light

(output,) = sys.argv[1:]
# A room: Gaussians on a sphere of radius 3 around two balls, with a bright window.
count = 20_000
directions = np.random.default_rng(0).normal(size=(count, 3))
directions /= np.linalg.norm(directions, axis=1, keepdims=True)
colors = 0.5 + 0.2 * np.sin(4 * directions)
colors[directions @ (0.5, 0.8, -0.33) > 0.9] = encode_light(np.array(5.0))  # five times white
gaussians = morgs_mi.Gaussians.from_activated(
    3 * directions,
    np.full((count, 3), 0.07),
    np.tile([1, 0, 0, 0], (count, 1)),
    np.full(count, 0.95),
    (colors[:, None] - 0.5) / morgs_mi.SH_C0,
)
camera = morgs_mi.Camera.look_at((0, 0.4, -2.2), (0, 0, 0), (0, 1, 0), 60, 240, 160)
gold = {"type": "roughconductor", "material": "Au", "alpha": 0.1}
scene = mi.load_dict(
    {
        "type": "scene",
        "gaussians": morgs_mi.ellipsoids(gaussians),
        "glossy": {"type": "sphere", "center": [-0.5, 0, 0], "radius": 0.4, "bsdf": gold},
        "diffuse": {"type": "sphere", "center": [0.5, 0, 0], "radius": 0.4},
        "light": morgs_mi.light_probe(gaussians, position=(0, 0, 0), clipped=1),
        "sensor": camera.sensor(),
        "integrator": {"type": "gaussian_splat", "surfaces": {"type": "path", "max_depth": 4}},
    }
)
mi.util.write_bitmap(output, mi.render(scene, spp=64))

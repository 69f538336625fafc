"""Optimise Gaussians against an image in Mitsuba: python examples/optimise.py optimised.png."""

import sys

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import morgs_mi

rng = np.random.default_rng(0)
N = 300
camera = morgs_mi.Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 40, 96, 96)
y, x = np.mgrid[-1:1:96j, -1:1:96j]
colors = np.stack([0.5 + 0.5 * x, 0.5 + 0.5 * y, 0 * x + 0.3], axis=2)
disc = (x**2 + y**2 < 0.6)[..., None] * colors
target = mi.TensorXf(disc.astype(np.float32))  # linear RGB [96, 96, 3]
gaussians = morgs_mi.Gaussians.from_activated(
    means=rng.uniform(-0.8, 0.8, (N, 3)) * (1, 1, 0.1),
    scales=np.full((N, 3), 0.06),
    quats=rng.normal(size=(N, 4)),
    opacities=np.full(N, 0.5),
    sh_coeffs=rng.normal(0, 0.3, (N, 1, 3)),
)
parts = {"gaussians": morgs_mi.ellipsoids(gaussians), "sensor": camera.sensor()}
scene = mi.load_dict({"type": "scene", **parts, "integrator": {"type": "gaussian_splat"}})
params = mi.traverse(scene)
params.keep(["gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs"])
optimiser = mi.ad.Adam(lr=5e-3, params=params)
first_image = mi.render(scene)
for _ in range(150):
    params.update(optimiser)
    image = mi.render(scene, params)
    dr.backward(dr.mean(dr.square(image - target), axis=None))
    optimiser.step()
    optimiser["gaussians.opacities"] = dr.clip(optimiser["gaussians.opacities"], 0.01, 0.99)
pictures = [np.array(picture) for picture in (first_image, image, target)]
mi.util.write_bitmap(sys.argv[1], np.concatenate(pictures, axis=1))

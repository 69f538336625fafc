"""Render a file of Gaussians in Mitsuba: python examples/render_ply.py scene.ply render.exr."""

import sys

import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
import morgs_mi

path, output = sys.argv[1:]
gaussians = morgs_mi.read_splats(path)
camera = morgs_mi.open_stream(path).cameras[0]  # of a rig around the Gaussians
print(gaussians, camera, sep="\n")

scene = mi.load_dict(
    {
        "type": "scene",
        "gaussians": morgs_mi.ellipsoids(gaussians),
        "sensor": camera.square().sensor(),
        "integrator": {"type": "gaussian_splat", "aovs": "depth", "background": 1.0},
    }
)
# The channels R, G, B in linear light, and depth.Y in world units.
mi.render(scene)
scene.sensors()[0].film().bitmap().write(output)

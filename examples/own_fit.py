"""Fit images by a loop of one's own, with density control: python examples/own_fit.py fit.png"""

import sys
import tempfile

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import morgs_mi

STEPS = 600
clip = morgs_mi.SynthConfig(cameras=9, frames=1, width=160, height=120, spp=64)
capture = morgs_mi.load_capture(morgs_mi.synthesize("spheres", tempfile.mkdtemp() + "/clip", clip))
frame = next(capture.frames())
views = frame.train
start = morgs_mi.from_points(capture.points, capture.point_colors, sh_degree=1)
optimizer = mi.ad.Adam(lr=1e-3, params=start.parameters())
control = morgs_mi.DensityControl(views.cameras)
rates = morgs_mi.FitConfig().first_frame_rates.by_parameter(control.extent)
for step in range(STEPS):
    if step in range(60, 301, 48):
        for view in views:
            control.observe(optimizer, view.camera, view.image)
        control.step(optimizer, births=500)
    optimizer.set_learning_rate({name: 0.1 ** (step / STEPS) * rates[name] for name in optimizer})
    view = views[step % len(views)]
    image = morgs_mi.rasterize(morgs_mi.Gaussians.from_parameters(optimizer), view.camera).color
    target = mi.TensorXf(view.image.astype(np.float32) / 255)
    dr.backward(dr.mean(dr.abs(image - target), axis=None))
    optimizer.step()
gaussians = morgs_mi.Gaussians.from_parameters(optimizer)
(held_out,) = frame.test
color = morgs_mi.rasterize(gaussians, held_out.camera).color
row = [held_out.image, morgs_mi.channel_image("color", color)]
print(f"PSNR {-10 * np.log10(np.mean((row[0] / 255 - row[1] / 255) ** 2)):.2f} dB, {gaussians}")
mi.util.write_bitmap(sys.argv[1], np.concatenate(row, axis=1))  # held-out view, render

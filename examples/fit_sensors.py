"""Fit images of Mitsuba's sensors by one call: python examples/fit_sensors.py fit.png"""

import sys
import tempfile

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import morgs_mi

# Path-traced images; yours come from mi.render or from files.
clip = morgs_mi.SynthConfig(cameras=9, frames=1, width=160, height=120, spp=64)
capture = morgs_mi.load_capture(morgs_mi.synthesize("spheres", tempfile.mkdtemp() + "/clip", clip))
sensors = [mi.load_dict(camera.sensor()) for camera in capture.cameras]
images = next(capture.frames()).images

train = capture.train_views
views = [sensors[v] for v in train]
recorded = [images[v] for v in train]
points = capture.points, capture.point_colors
fit = morgs_mi.FitConfig(num_gaussians=11000, first_frame_steps=600)
gaussians = morgs_mi.fit_gaussians(views, recorded, *points, morgs_mi.StreamConfig(fit=fit))

held_out = capture.test_views[0]
color = morgs_mi.rasterize(gaussians, capture.cameras[held_out]).color
row = [images[held_out], morgs_mi.channel_image("color", color)]
print(f"PSNR {-10 * np.log10(np.mean((row[0] / 255 - row[1] / 255) ** 2)):.2f} dB, {gaussians}")
mi.util.write_bitmap(sys.argv[1], np.concatenate(row, axis=1))  # held-out view, render

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
frame = next(capture.frames())
sensors = [mi.load_dict(view.camera.sensor()) for view in frame.train]
images = [view.image for view in frame.train]

points = capture.points, capture.point_colors
fit = morgs_mi.FitConfig(num_gaussians=11000, first_frame_steps=600)
fitted = morgs_mi.fit_gaussians(sensors, images, *points, morgs_mi.StreamConfig(fit=fit))

(held_out,) = frame.test
color = morgs_mi.rasterize(fitted.gaussians, held_out.camera).color
row = [held_out.image, morgs_mi.channel_image("color", color)]
print(
    f"PSNR {-10 * np.log10(np.mean((row[0] / 255 - row[1] / 255) ** 2)):.2f} dB, {fitted.gaussians}"
)
mi.util.write_bitmap(sys.argv[1], np.concatenate(row, axis=1))  # held-out view, render

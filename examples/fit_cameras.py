"""Fit the images of fixed cameras, frame by frame: python examples/fit_cameras.py fit.png."""

import sys
import tempfile

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import morgs_mi

(output,) = sys.argv[1:]
# A path-traced clip; yours has a View with a Camera, and an image uint8 [H, W, 3], of each camera,
# and points [P, 3] with colours.
clip = morgs_mi.SynthConfig(cameras=6, frames=4, width=96, height=72, spp=16)
capture = morgs_mi.load_capture(morgs_mi.synthesize("spheres", tempfile.mkdtemp() + "/clip", clip))

config = morgs_mi.StreamConfig(fit=morgs_mi.FitConfig(num_gaussians=3000, first_frame_steps=300))
loop = morgs_mi.StreamLoop(capture.views.train, capture.points, capture.point_colors, config)
for frame in capture.frames():
    packet, report = loop.push(frame.train)
    print(report)

print(loop.gaussians)
(held_out,) = frame.test
channels = ("color", "motion", "confidence")
image = morgs_mi.rasterize(loop.gaussians, held_out.camera, channels)
row = [
    held_out.image,
    morgs_mi.channel_image("color", image.color),
    morgs_mi.motion_image(image.motion, 2, image.color),
    morgs_mi.confidence_image(image.confidence),
]
mi.util.write_bitmap(output, np.concatenate(row, axis=1))  # truth, render, motion, confidence

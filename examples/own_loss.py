"""Fit a clip with a loss term of one's own: python examples/own_loss.py loss.png."""

import sys
import tempfile

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import morgs_mi

(output,) = sys.argv[1:]


@morgs_mi.loss_term("speed")
def speed_loss(prediction, observations, config):
    """Return the mean speed of the Gaussians that are fitted, in scene extents per frame."""
    return dr.mean(dr.abs(prediction.gaussians.motion), axis=None) / prediction.extent


clip = morgs_mi.SynthConfig(cameras=4, frames=3, width=96, height=72, spp=16)
capture = morgs_mi.load_capture(morgs_mi.synthesize("spheres", tempfile.mkdtemp() + "/clip", clip))
pictures = []
for terms in ((), ("speed:10",)):
    objective = morgs_mi.ObjectiveConfig(terms=terms)
    fit = morgs_mi.FitConfig(num_gaussians=2000, first_frame_steps=200, objective=objective)
    loop = morgs_mi.StreamLoop.of(capture, morgs_mi.StreamConfig(fit=fit))
    for frame in capture.frames():
        _, report = loop.push(frame.train)
    print(terms, report.losses, abs(np.array(loop.gaussians.motion)).mean())
    image = morgs_mi.rasterize(loop.gaussians, capture.views.test[0].camera, ("color", "motion"))
    pictures.append(morgs_mi.motion_image(image.motion, 2, image.color))
mi.util.write_bitmap(output, np.concatenate(pictures, axis=1))  # motion without and with the term

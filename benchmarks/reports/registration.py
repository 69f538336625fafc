"""Registration of a held-out view: the camera, near the calibrated one, that fits its image best
while the Gaussians are frozen.

With the blend weights w of the Gaussians fixed, the error e = target - image is linear in the shift
u of a splat (Lucas and Kanade 1981; as in `method.motion`): with the gradient g, it becomes e + g .
u. A Gaussian is therefore an observation of `NormalEquations` with

    G = sum_x w g g' / v,    b = sum_x w e g / v,

where the variance v is the mean square error times the number of pixels with similar errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.view import View
from morgs_mi.extras.calibration.bundle import (
    CHANGES,
    NormalEquations,
    camera_jacobian,
    changed_camera,
    prior_deviations,
)
from morgs_mi.extras.calibration.offset_equations import (
    blurred,
    gradient_products,
    image_gradient,
)
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.render_config import RenderConfig

# Number of pixels with similar errors, because the fit lacks a detail there. They count as one
# pixel: otherwise priors would have no influence, and a camera would follow the errors of the fit.
_ALIKE = 10.0
# px, standard deviations of the blur of images and gradients, one after the other: a blurred image
# registers errors of several pixels.
_BLURS = (2.0, 1.0, 0.0)
# Error at which a pixel has half its weight, relative to white: larger errors are details that the
# fit lacks.
_HALF_WEIGHT = 0.1
# Least mean square error: a rendering compared with itself has an error of 0.
_LEAST_ERROR = 1e-10
# Deviation of a fixed distortion.
_NO_DISTORTION = 1e-4
# Steps of the registration, which end when they change the pixels by less than this, px.
_STEPS = 30
_LEAST_SHIFT = 1e-3


def register_camera(
    gaussians: Gaussians,
    view: View,
    extent: float,
    config: FitConfig,
    render: RenderConfig,
) -> Camera:
    """Return the camera, near the given one, with which frozen Gaussians fit an image best.

    Args:
        gaussians: frozen.
        view: the calibrated camera and its image.
        extent: scene extent, world units.
        config: settings with the priors of the changes.
        render: cut-offs.
    """
    priors = replace(config.camera_priors, distortion=_NO_DISTORTION)  # the image is not changed
    deviations = prior_deviations(extent, priors)
    target = Target(view.image, view.mask)
    means = np.asarray(gaussians.means, np.float64)
    best = np.zeros((1, CHANGES))
    for blur in _BLURS:
        changes = best
        error = np.inf
        for _ in range(_STEPS):
            camera = changed_camera(view.camera, changes[0])
            G, b, new_error = _shifts(gaussians, camera, target, blur, render)
            if not new_error < error:
                break
            best = changes
            error = new_error
            of_camera, _ = camera_jacobian(camera, 1 + changes[0, 6], means)
            equations = NormalEquations(1, 0)
            equations.add_camera(0, of_camera, G / error / _ALIKE, b / error / _ALIKE)
            step, _ = equations.step(changes, deviations, 0.0, np.zeros((0, CHANGES)))
            changes = changes + step
            if np.abs(of_camera @ step[0]).mean() < _LEAST_SHIFT:
                break
    return changed_camera(view.camera, best[0])


def _shifts(
    gaussians: Gaussians, camera: Camera, target: Target, blur: float, render: RenderConfig
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return G v [N, 2, 2] and b v [N, 2] of the module docstring in a view, and the mean square
    error.
    """
    view = ActiveView(camera, render)
    image = render_view(gaussians, view).color
    error = target.difference(image)
    square = max(float(np.mean(error**2)), _LEAST_ERROR)
    # The mean of the rendering and the target, or the rendering where the target is masked.
    gradient = image_gradient(blurred((np.asarray(image) + 0.5 * error).astype(np.float32), blur))
    error = blurred(error, blur)
    weight = 1 / (1 + np.sum(error**2, axis=-1) / _HALF_WEIGHT**2)
    return *gradient_products(gaussians, view, error, gradient, weight), square

"""A ball of Gaussians and its images in four views, which a fit reconstructs."""

import dataclasses

import numpy as np

from morgs_mi import RenderConfig, rasterize
from morgs_mi.core.view import View
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.initialise import FirstFrameProblem, from_points
from tests.scenes.cameras import QUAD, look_at_cameras


def ball(n, sh_degree=0):
    """Return n Gaussians in a cube, coloured by position."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.8, 0.8, (n, 3))
    return from_points(points, 0.5 + 0.4 * np.sin(5 * points), sh_degree)


def opaque_ball():
    """Return 400 Gaussians, opaque enough to hide what is behind."""
    return dataclasses.replace(ball(400), logit_opacities=np.full(400, 2.0))


def views():
    """Return four cameras in front of the ball."""
    return look_at_cameras(QUAD, 40)


def images_of(gaussians):
    """Return the images [H, W, 3] of the Gaussians in `views`."""
    return [np.clip(np.asarray(rasterize(gaussians, c, ("color",)).color), 0, 1) for c in views()]


def bytes_of(images, noise=0.0):
    """Return images as uint8, with normal noise of a standard deviation relative to white."""
    rng = np.random.default_rng(0)
    return [
        np.uint8(np.clip(255 * (image + rng.normal(0, noise, image.shape)) + 0.5, 0, 255))
        for image in images
    ]


def problem(images, start=None, masks=None, render=None):
    """Return the problem of a first frame with some or all of the `views`."""
    masks = [None] * len(images) if masks is None else masks
    views_of_images = [
        View(*view) for view in zip(views()[: len(images)], images, masks, strict=True)
    ]
    return FirstFrameProblem(
        start or ball(80), tuple(views_of_images), np.zeros((0, 3)), 3.0, render or RenderConfig()
    )


def mean_psnr(gaussians, images):
    """Return the mean PSNR of the Gaussians in `views`, dB."""
    return float(np.mean([psnr(a, b) for a, b in zip(images_of(gaussians), images, strict=True)]))

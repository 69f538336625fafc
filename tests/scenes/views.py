"""Active views with static splats, and with images."""

import numpy as np

from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView, ViewGroup
from morgs_mi.render.rasterize import render_view


def make_active_view(camera, region, static, channels, config):
    """Return the view of a region with the static Gaussians that touch it."""
    (view,) = ViewGroup([ActiveView(camera, config, region)]).with_static(static, channels)
    return view


def observed(views, images):
    """Return active views, by index, with an image [H, W, 3] each."""
    return {v: ObservedView.of(views[v], Target(image)) for v, image in enumerate(images)}


def rendered_as(gaussians, views, flows=None):
    """Return active views, by index, with images of Gaussians, and with the flow of key views."""
    seen = {}
    for v, view in views.items():
        target = Target(np.asarray(render_view(gaussians, view).color))
        seen[v] = ObservedView.of(view, target, flow=(flows or {}).get(v))
    return seen

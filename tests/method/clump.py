"""A bright clump of Gaussians that moves in front of a dark static wall, in two views."""

from dataclasses import replace

import numpy as np

from morgs_mi.render.active_view import ActiveView
from tests.scenes.cameras import look_at_cameras
from tests.scenes.gaussians import isotropic, random_sheet
from tests.scenes.views import rendered_as

STATIC = 400


def clump_and_wall(count, radius, shift, width=64, height=48):
    """Return the Gaussians, the mask of those that move, and views with images after the motion.

    Args:
        count: number of Gaussians that move.
        radius: standard deviation of their means, world units.
        shift: their displacement [3], world units.
        width: of the images, px.
        height: of the images, px.
    """
    rng = np.random.default_rng(0)
    wall = random_sheet(rng, STATIC, 1.2, 0.6)
    means = np.concatenate([rng.normal(0, radius, (count, 3)), wall])
    colors = np.concatenate(
        [rng.uniform(0.5, 1.5, (count, 1, 3)), rng.uniform(-1.5, -1, (STATIC, 1, 3))]
    )
    gaussians = isotropic(means, 0.05, 0.9, colors)
    moves = np.arange(count + STATIC) < count
    target = replace(gaussians, means=np.asarray(gaussians.means) + shift * moves[:, None])
    cameras = look_at_cameras([(x, 0.3, -3) for x in (-0.8, 0.8)], 45, width, height)
    return gaussians, moves, rendered_as(target, dict(enumerate(map(ActiveView, cameras))))

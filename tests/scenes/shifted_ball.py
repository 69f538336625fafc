"""A ball that moves as a whole into the next frame, for tests of shared motion."""

from dataclasses import replace

import numpy as np

from morgs_mi import RenderConfig
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.motion_config import MotionConfig
from tests.scenes.ball import images_of, opaque_ball, views
from tests.scenes.views import observed

SHIFT = np.array([0.06, -0.03, 0.02], np.float32)
EXTENT = 3.0
PLAIN = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)
FIT = FitConfig(sh_degree=0, epochs=8, density=DensityConfig(later_frames=False))


def shifted_ball():
    """Return the ball after its motion."""
    ball = opaque_ball()
    return replace(ball, means=np.asarray(ball.means) + SHIFT)


def fit_shifted(motion, start=None, config=FIT):
    """Fit the ball to images of its shifted self, with the same bytes on every run."""
    ball = opaque_ball()
    active = full_active_set(ball, dict(enumerate(views())), RenderConfig())
    fitted_views = observed(active.views, images_of(shifted_ball()))
    problem = FrameProblem(ball, active, fitted_views, start, EXTENT)
    return fit_later_frame(problem, config, motion, np.random.default_rng(0))


def motion_error(result):
    """Return the mean error of the displacements, in world units."""
    return float(np.linalg.norm(np.asarray(result.gaussians.motion) - SHIFT, axis=1).mean())

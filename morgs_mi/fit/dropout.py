"""Dropout of Gaussians, which improves novel views (DropGaussian, Park et al. 2025).

Where training views are few or noisy, Gaussians overfit them together: one compensates for another
in a single view. In every step of the first frame, each Gaussian is left out with probability p,
and the opacities of the others are scaled by 1 / (1 - p). p follows from the number of views, their
noise and the angles between them.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.attributes import sigmoid
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.fit.detail import is_noisy
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import forecast
from morgs_mi.fit.problem import FirstFrameProblem

# Number of views that are fitted without dropout.
_MANY_VIEWS = 6
# Logit of an opacity that no cut-off of the renderer lets pass.
_INVISIBLE = -30.0
# Largest opacity, which has a finite logit.
_MOST = 0.999
# Probability with which few views are fitted that are noisy or far apart.
_DROPOUT = 0.2
# Least `Forecast.reach` of views that are far apart, degrees.
_FAR = 24.0


def dropped(gaussians: Gaussians, probability: float, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians as one step of the first frame renders them, differentiable.

    Args:
        gaussians: N Gaussians.
        probability: with which each is left out, below 1; 0: none is.
        rng: draws which.
    """
    if not probability:
        return gaussians
    is_kept = from_numpy(mi.UInt32, rng.random(len(gaussians), np.float32) >= probability) != 0
    opacity = dr.minimum(
        sigmoid(gaussians.logit_opacities.array) * dr.opaque(mi.Float, 1 / (1 - probability)), _MOST
    )
    logits = dr.select(is_kept, dr.log(opacity) - dr.log(1 - opacity), _INVISIBLE)
    return replace(gaussians, logit_opacities=mi.TensorXf(logits))


def adapted_to_images(config: FitConfig, problem: FirstFrameProblem) -> FitConfig:
    """Return the settings of the first frame with what follows from its images: dropout, and the
    loss of noisy ones.

    Noisy images are fitted by L1 alone if `noise_aware`. Few views that are noisy or far apart are
    fitted with dropout, unless it is given.
    """
    noisy = is_noisy([view.image for view in problem.views])
    if config.noise_aware and noisy:
        config = replace(config, objective=replace(config.objective, dssim_weight=0.0))
    if config.dropout is not None:
        return config
    views = len(problem.views)
    few = views < _MANY_VIEWS
    far = few and views > 1 and forecast(problem.cameras, problem.points).reach >= _FAR
    return replace(config, dropout=_DROPOUT if few and (noisy or far) else 0.0)

"""The rendering error of each Gaussian, by its blend weights.

With the error e(x) of a rendered view, E_i = sum_x w_i(x) e(x) is the error attributed to Gaussian
i there (Bulo et al. 2024), in pixels of full contrast. Its densification score is the largest one
over the views.

It is the gradient of sum_x f(x) e(x) for a feature that is blended like a colour and is 0
everywhere: the adjoint of a step gives it along with the gradients of its losses.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Bool, Float, Tensor
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.method.sweep import KeyImages
from morgs_mi.render.backend import elements
from morgs_mi.render.rasterize import Image
from morgs_mi.render.region import Region

# Error that counts as noise, in typical errors of the image: normal noise, independent in three
# colours, exceeds 3 at 3 of 10,000 pixels.
NOISE = 3.0


class ErrorPerGaussian:
    """Densification scores of N Gaussians from the steps of an optimisation that it observes,
    without a pass of their own.

    Args:
        count: N.
        skip: number of steps before the first one that counts.

    Attributes:
        term: sum over the image of feature times error, which is 0: the gradients of the features
            are E. None: the step does not count.
        skip: number of steps before the first one that counts.
        scores: of the steps so far, [N].
    """

    def __init__(self, count: int, skip: int = 0) -> None:
        self.term: Tensor | None = None
        self._count = count
        self.skip = skip
        self._probe: Tensor | None = None
        self.scores = dr.zeros(mi.Float, count)

    def features(self) -> Tensor | None:
        """Return the features [N, 1] to render in the next step, with detached weights; None: the
        step does not count.
        """
        if self.skip > 0:
            return None
        self._probe = probe = dr.zeros(mi.TensorXf, (self._count, 1))
        dr.enable_grad(probe)
        return probe

    def observe(self, image: Image, target: Target, region: Region | None) -> None:
        """Attribute the error of a step's image to its features.

        Errors below three times the typical error of the image do not count: they are noise.

        Args:
            image: the rendering with the colour and the features.
            target: its target.
            region: the drawn blocks; None: the whole view.
        """
        pixels, weight = target.on(region)
        self.term = attribution(image, pixels, weight)

    def collect(self) -> None:
        """Update the scores from the gradients of a step."""
        probe = self._probe
        self.update(1, 0 if probe is None else dr.grad(probe).array)
        self._probe = None
        self.term = None

    def update(self, steps: int, scores: Float | float) -> None:
        """Count some steps, and keep the larger of the scores so far and theirs."""
        self.skip -= steps
        self.scores = dr.maximum(self.scores, scores)
        dr.eval(self.scores)


def attribution(image: Image, pixels: Float, weight: Float | None) -> Tensor:
    """Return the sum over an image of feature times error, see `ErrorPerGaussian.observe`.

    Args:
        image: a rendering with the colour and the features.
        pixels: the target there, flat.
        weight: of its numbers; None: 1.
    """
    color = dr.detach(image.color).array
    difference = dr.abs(pixels - (color if weight is None else color * weight))
    pixel = dr.arange(mi.UInt32, dr.width(difference) // 3) * 3
    error = sum(elements(difference, pixel + c) for c in range(3)) / 3
    # About the median of the errors that are not 0: the mean of those below twice the mean.
    mean = _mean_of(error, error > 0)
    error = dr.maximum(error - NOISE * _mean_of(error, (error > 0) & (error < 2 * mean)), 0)
    return dr.sum(image.features * mi.TensorXf(error, image.features.shape), axis=None)


def _mean_of(values: Float, selection: Bool) -> Float:
    """Return the mean of some values, 0 of none. It is summed in double precision: zeros that fill
    up an array change the order of a sum, and would change its last bit.
    """
    total = dr.sum(mi.Float64(dr.select(selection, values, 0)))
    return mi.Float(total / dr.maximum(mi.Float64(dr.count(selection)), 1))


def densification_scores(gaussians: Gaussians, views: Sequence[ObservedView]) -> np.ndarray:
    """Render every view and return the densification scores [N] of the Gaussians.

    Args:
        gaussians: N Gaussians.
        views: V active views with their images.
    """
    gaussians = gaussians.detached()
    errors = [KeyImages({0: view}).sums(gaussians, ("error",))["error"][0] for view in views]
    return np.max(errors, axis=0)

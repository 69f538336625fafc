"""Depth of single images, estimated by a network that the user brings, as a prior of the first frame.

Few views leave open where a surface without texture lies. A network that was trained on other images estimates it, as
relative inverse depth: what it returns is a / z + b, with an unknown scale and shift in every view. They follow from
the capture's points in the view, by least absolute deviations, as points that other surfaces hide are outliers. A view
with too few points is aligned several times in the course of the fit, to the depth of the Gaussians at that time.

The network is an ONNX file with the signature of Depth Anything (Yang et al., CVPR 2024, and V2, NeurIPS 2024): an
image [1, 3, H, W], normalised by ImageNet's colours, and the inverse depth [1, H, W] or [1, 1, H, W]. The package
contains none.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Tensor
from morgs_mi.fit.initialise import seen_points
from morgs_mi.io.onnx_file import OnnxNetwork, imagenet_blob, read_signature, written_shapes
from morgs_mi.losses.losses import depth_loss
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import Image

__all__ = ["AlignedDepth", "DepthNetwork", "DepthPrior", "depth_prior", "fit_line", "fit_line_robustly"]

_LOG = logging.getLogger(__name__)

# Of a network that leaves its size open: the shorter side and the unit of both sides that Depth Anything was trained
# with, px.
_SIDE, _MULTIPLE = 518, 14
# Least number of points, or of rendered pixels, to which a view is aligned.
_MIN_SAMPLES = 20
# Alpha from which a pixel's rendered depth counts for the alignment.
_OPAQUE = 0.5
_ROUNDS = 20
# Fraction of known pixels from which a reduced one is known: all, but for rounding.
_WHOLE = 0.999


class DepthNetwork:
    """Depth network: called with an image, it returns its relative inverse depth.

    Args:
        path: the ONNX file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not an ONNX file, OpenCV cannot load it, or it does not take a single image.
    """

    def __init__(self, path: str | Path) -> None:
        signature = read_signature(path)
        shapes = list(signature.inputs.values())
        if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][0] not in (1, None) or shapes[0][1] not in (3, None):
            raise ValueError(
                f"{path}: expected a depth network with one image [1, 3, H, W] as its input, got "
                f"{written_shapes(shapes)}; export one with the signature of Depth Anything."
            )
        self._height, self._width = shapes[0][2:]
        self._name = next(iter(signature.inputs))
        self._network = OnnxNetwork(path, signature)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the inverse depth [H, W], float32, up to scale and shift.

        Args:
            image: [H, W, 3], RGB, uint8 or float in [0, 1].

        Raises:
            ValueError: the network cannot run at this size, or does not return one finite number per pixel.
        """
        path, (height, width) = self._network.path, image.shape[:2]
        scale = _SIDE / min(height, width)
        down, across = self._height or _multiple(scale * height), self._width or _multiple(scale * width)
        outputs = self._network.run({self._name: imagenet_blob(image, across, down)})
        maps = [output for output in outputs if output.shape in ((1, down, across), (1, 1, down, across))]
        if not maps:
            raise ValueError(
                f"{path}: expected an output [1, {down}, {across}], the inverse depth, got "
                f"{written_shapes([output.shape for output in outputs])}; export the network's depth alone."
            )
        found = maps[-1].reshape(down, across).astype(np.float32)
        if not np.isfinite(found).all():
            raise ValueError(f"{path}: expected a finite inverse depth, got NaN or infinity; export it in float32.")
        return cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True, eq=False)
class AlignedDepth:
    """Inverse depth of a view in world units.

    Attributes:
        inverse: [H, W], 1 / world units.
        known: [H, W], 1 where it is known and 0 elsewhere.
        unit: inverse depth by which errors are divided, the median of what it is aligned to, 1 / world units.
        final: whether it is aligned to points, and not to Gaussians that are still fitted.
    """

    inverse: Tensor
    known: Tensor
    unit: float
    final: bool

    def loss(self, image: Image) -> Tensor:
        """Return the depth term of an image of the view, with depth and alpha; no gradient passes through alpha."""
        weights = mi.TensorXf(dr.detach(image.alpha).array * self.known.array, tuple(self.known.shape))
        return depth_loss(image.depth, self.inverse, weights, self.unit)

    def reduced(self, camera: Camera) -> AlignedDepth:
        """Return the inverse depth at the size of a camera; a pixel is known if all that it covers is."""
        inverse, known = (_reduced(np.asarray(values), camera) for values in (self.inverse, self.known))
        return replace(self, inverse=_tensor(inverse), known=_tensor(known > _WHOLE))


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """Inverse depth of all views.

    Attributes:
        relative: up to scale and shift [H, W] of each view, NaN where it is unknown.
        aligned: of each view in world units; None: not aligned yet.
    """

    relative: tuple[np.ndarray, ...]
    aligned: tuple[AlignedDepth | None, ...]

    def realigned(self, gaussians: Gaussians, views: Sequence[ActiveView]) -> DepthPrior:
        """Return the prior with the views that have too few points aligned to the depth of Gaussians.

        Args:
            gaussians: that have been fitted for some steps.
            views: all views.
        """
        aligned = (
            found if found is not None and found.final else _aligned_to_render(relative, view, gaussians)
            for found, relative, view in zip(self.aligned, self.relative, views, strict=True)
        )
        return replace(self, aligned=tuple(aligned))

    def reduced(self, views: Sequence[int], cameras: Sequence[Camera]) -> DepthPrior:
        """Return the prior of some views at a smaller size.

        Args:
            views: indices of the views.
            cameras: of these views, of that size.
        """
        return DepthPrior(
            tuple(_reduced(self.relative[v], camera) for v, camera in zip(views, cameras, strict=True)),
            tuple(
                None if (found := self.aligned[v]) is None else found.reduced(camera)
                for v, camera in zip(views, cameras, strict=True)
            ),
        )


def depth_prior(
    relative: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    points: np.ndarray,
    masks: Sequence[np.ndarray | None] | None = None,
) -> DepthPrior:
    """Return the prior of views whose inverse depth is known up to scale and shift.

    Args:
        relative: inverse depth [H, W] of each of V views, up to scale and shift.
        cameras: the V views.
        points: [P, 3] of the capture, world units.
        masks: valid pixels of each view [H, W], or None.
    """
    masks = (None,) * len(cameras) if masks is None else masks
    maps = tuple(r if m is None else np.where(m, r, np.nan) for r, m in zip(relative, masks, strict=True))
    aligned = tuple(_aligned_to_points(r, camera, points) for r, camera in zip(maps, cameras, strict=True))
    missing = [camera.name for camera, found in zip(cameras, aligned, strict=True) if found is None]
    if missing:
        _LOG.info("the depth of %s is aligned to the fit, as too few points lie there", ", ".join(missing))
    return DepthPrior(maps, aligned)


def fit_line(x: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Return the scale a and the shift b that minimise sum w (a x + b - y)^2, in float64.

    Args:
        x: [M], not all equal where the weights are positive.
        y: [M].
        weights: [M], not negative.
    """
    x, y, weights = (np.asarray(values, np.float64) for values in (x, y, weights))
    x_mean, y_mean = np.average(x, weights=weights), np.average(y, weights=weights)
    scale = np.sum(weights * (x - x_mean) * (y - y_mean)) / np.sum(weights * (x - x_mean) ** 2)
    return float(scale), float(y_mean - scale * x_mean)


def fit_line_robustly(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return the scale a and the shift b that minimise sum |a x + b - y|, by iteratively reweighted least squares.

    Args:
        x: [M], not all equal.
        y: [M].
    """
    weights = np.ones(len(x))
    scale, shift = fit_line(x, y, weights)
    least = 1e-6 * max(float(np.ptp(y)), 1e-30)  # exact residuals would have an infinite weight
    for _ in range(_ROUNDS):
        weights = 1 / np.maximum(np.abs(scale * x + shift - y), least)
        scale, shift = fit_line(x, y, weights)
    return scale, shift


def _aligned_to_points(relative: np.ndarray, camera: Camera, points: np.ndarray) -> AlignedDepth | None:
    """Return the inverse depth of a view by the points that it shows; None if they are too few."""
    _, pixels, depths = seen_points(camera, points)
    columns, rows = pixels.astype(int).T
    return _aligned(relative, relative[rows, columns], 1 / depths, final=True)


def _aligned_to_render(relative: np.ndarray, view: ActiveView, gaussians: Gaussians) -> AlignedDepth | None:
    """Return the inverse depth of a view by the depth of Gaussians; None if they fill too little of it."""
    with dr.suspend_grad():
        image = view.render(gaussians, ("depth", "alpha"))
    depth, alpha = (np.asarray(image[name], np.float64)[..., 0] for name in ("depth", "alpha"))
    drawn = (alpha > _OPAQUE) & (depth > 0)
    return _aligned(relative, relative[drawn], 1 / depth[drawn], final=False)


def _aligned(relative: np.ndarray, samples: np.ndarray, inverse: np.ndarray, final: bool) -> AlignedDepth | None:
    """Return a x + b of the relative inverse depth x, with those of the samples; None if they do not determine it.

    A scale that is not positive means that the network and the samples contradict each other.
    """
    known = np.isfinite(samples)
    x, y = samples[known].astype(np.float64), inverse[known]
    if len(x) < _MIN_SAMPLES or np.ptp(x) == 0:
        return None
    scale, shift = fit_line_robustly(x, y)
    if not scale > 0:
        return None
    # Beyond infinity, as the sky can be where all samples are near, is infinity.
    whole, valid = np.maximum(scale * relative + shift, 0), np.isfinite(relative)
    return AlignedDepth(_tensor(np.where(valid, whole, 0)), _tensor(valid), float(np.median(y)), final)


def _reduced(values: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the means of a map [H, W] over the pixels of a camera, NaN where any value is."""
    return cv2.resize(values.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def _tensor(values: np.ndarray) -> Tensor:
    return from_numpy(mi.TensorXf, values.astype(np.float32))


def _multiple(side: float) -> int:
    """Return the multiple of `_MULTIPLE` nearest to a side, at least one."""
    return max(1, round(side / _MULTIPLE)) * _MULTIPLE

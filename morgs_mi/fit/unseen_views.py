"""Forecast of views between the cameras of a fitted first frame, without a second fit.

Novel views have a lower PSNR than training views. The mean difference, the loss in dB, is modelled
as a linear function of two features that need no further image: the PSNR of the training views, and
their

    disagreement    10 log10(1 + d / e) ,

where e is the mean square error of the training views. d compares each of them with its nearest
other cameras: a pixel's point, at the rendered depth, has a colour in each of their images, and the
least square difference from the rendered colour counts. A surface at a wrong depth shows colours
that no other camera has recorded there, however well the Gaussians fit the view itself.

The coefficients are a ridge regression on the held-out views of photos, rigs and synthetic clips.
The interval is conformal: nine tenths of the scaled errors on captures that the regression has not
seen are smaller (`benchmarks/reports/unseen.py`, `docs/experiments/real.md`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import unit_values
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.rig import angles_to, in_image, scene_depths
from morgs_mi.fit.forecast import Forecast, forecast, quality_of
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.fit.view import View, mean_psnr
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

WIDEST = 6.0
"""Width of an interval in dB beyond which only the word is certain."""
WIDEST_REACH = 20.0
"""`Forecast.reach` in degrees beyond which the regression has no rigs: neighbours show something
else.
"""

# Nearest cameras whose images a view is compared with.
_NEAREST = 4
# Training views that are compared: more take time and change little.
_VIEWS = 8
# Pixels of a row that are compared, for the same reason.
_COLUMNS = 320
# Factor on the interval where a feature lies outside the range of the regression.
_OUTSIDE = 2.0


@dataclass(frozen=True)
class Regression:
    """Loss of views between the cameras, from the features of a fit: disagreement and training
    PSNR, both in dB.
    """

    intercept: float  #: Loss where both features are 0, dB.
    slopes: tuple[float, float]  #: dB per dB of each feature.
    lowest: tuple[float, float]  #: Least value of each feature in the data.
    highest: tuple[float, float]  #: Largest value of each feature in the data.
    spread: float  #: Half of the interval, relative to 1 dB plus the loss.

    def loss(self, features: Sequence[float]) -> float:
        """Return the loss of views between the cameras, dB, at least 0."""
        return max(float(self.intercept + np.dot(self.slopes, features)), 0.0)

    def scale(self, features: Sequence[float]) -> float:
        """Return what the errors of the loss grow in proportion to, dB."""
        return 1 + self.loss(features)

    def margin(self, features: Sequence[float]) -> float:
        """Return half of the interval of the loss, dB."""
        return self.spread * self.scale(features) * (_OUTSIDE if self.is_outside(features) else 1)

    def is_outside(self, features: Sequence[float]) -> bool:
        """Return whether a feature lies outside the range of the data."""
        bounds = zip(self.lowest, features, self.highest, strict=True)
        return any(not low <= value <= high for low, value, high in bounds)


# Of `python -m benchmarks.reports.unseen`; a test computes it from the committed rows.
REGRESSION = Regression(
    intercept=3.3749,
    slopes=(0.52415, -0.12762),
    lowest=(0.93027, 21.395),
    highest=(8.6393, 41.366),
    spread=0.83501,
)


@dataclass(frozen=True)
class UnseenViews:
    """Expected quality of views between the cameras of a fitted first frame."""

    rig: Forecast  #: Angles and overlap of the cameras.
    training_psnr: float  #: Mean PSNR of the training views, dB.
    loss: float  #: Expected difference of the views between the cameras, dB.
    margin: float  #: Nine times in ten, the mean loss differs from the expected one by less, dB.
    #: Whether few captures of the regression are like this one, and the margin is wider for that.
    is_outside: bool = False

    @property
    def expected_psnr(self) -> float | None:
        """Expected mean PSNR of views between the cameras, dB; None if only the word is certain."""
        is_uncertain = self._is_wide or 2 * self.margin > WIDEST
        return None if is_uncertain else self.training_psnr - self.loss

    @property
    def interval(self) -> tuple[float, float] | None:
        """PSNR between which the mean is nine times in ten, dB; None where only the word is
        certain.
        """
        psnr = self.expected_psnr
        return None if psnr is None else (psnr - self.margin, psnr + self.margin)

    @property
    def quality(self) -> str:
        """Quality to expect of views between the cameras: good, fair or poor; by the angles alone
        if they are wide.
        """
        return (
            self.rig.quality
            if self._is_wide
            else quality_of(self.training_psnr - self.loss, self.loss)
        )

    @property
    def _is_wide(self) -> bool:
        """Whether the regression has no rigs like this one: neighbours show something else."""
        return self.rig.reach > WIDEST_REACH

    @property
    def sentence(self) -> str:
        """Sentence on the expected quality of views between the cameras."""
        if self.interval is None:
            bound = f"They have at most {self.training_psnr:.0f} dB."
            return (
                f"Views between the cameras will be {self.quality}: {self.rig.description}. {bound}"
            )
        low, high = self.interval
        wider = (
            ", a wider range than usual because few measured captures are like this one"
            if self.is_outside
            else ""
        )
        return (
            f"Views between the cameras will be {self.quality}: {self.expected_psnr:.0f} dB in "
            f"the mean, nine times in ten between {low:.0f} and {high:.0f}{wider}; "
            f"{self.rig.description}."
        )

    @property
    def entries(self) -> dict[str, Any]:
        """Entries of the first frame's report: the attributes and the properties."""
        figures = {
            "quality": self.quality,
            "expected_psnr": self.expected_psnr,
            "interval": self.interval,
        }
        return {"sentence": self.sentence, **figures, **asdict(self)}


def unseen_views(problem: FirstFrameProblem, gaussians: Gaussians) -> UnseenViews:
    """Return the forecast of views between the cameras.

    Args:
        problem: the data of the first frame, at least two views.
        gaussians: fitted to it.
    """
    features = features_of(gaussians, problem.views, problem.points, problem.render)
    return UnseenViews(
        forecast(problem.cameras, problem.points),
        features[1],
        REGRESSION.loss(features),
        REGRESSION.margin(features),
        REGRESSION.is_outside(features),
    )


def features_of(
    gaussians: Gaussians, views: Sequence[View], points: np.ndarray, render: RenderConfig
) -> tuple[float, float]:
    """Return the disagreement of the training views and their mean PSNR, both in dB.

    Args:
        gaussians: fitted to the views.
        views: V training views, at least two.
        points: [P, 3] of the scene, world units, or none.
        render: cut-offs.
    """
    psnr = mean_psnr(gaussians, views, render)
    cameras = [view.camera for view in views]
    depths = scene_depths(cameras, points)
    squares = []
    for index in np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().astype(int):
        others = [views[other] for other in _nearest(cameras, index, depths[index])]
        squares.append(_disagreement(gaussians, views[index], others, render))
    return float(10 * np.log10(1 + np.mean(squares) * 10 ** (psnr / 10))), psnr


def _nearest(cameras: Sequence[Camera], index: int, depth: float) -> np.ndarray:
    """Return the indices of the cameras with the least angles to one, seen from a depth in it."""
    angles = angles_to(cameras[index], depth, cameras)
    angles[index] = np.inf
    return angles.argsort(kind="stable")[: min(_NEAREST, len(cameras) - 1)]


def _disagreement(
    gaussians: Gaussians, view: View, others: Sequence[View], render: RenderConfig
) -> float:
    """Return the mean of the least square difference of a pixel from what others recorded of its
    point.

    A pixel whose point none of them has recorded does not count; 1 where all are such.
    """
    camera = view.camera
    image = rasterize(gaussians, camera, ("color", "depth"), config=render)
    step = max(1, camera.width // _COLUMNS)
    color = np.clip(np.asarray(image.color)[::step, ::step], 0, view.white)
    depth = np.asarray(image.depth)[::step, ::step, 0].astype(float)
    points = _points_at(camera, depth, step)
    least = np.min([_squares(color, points, depth > 0, other) for other in others], axis=0)
    return float(least[np.isfinite(least)].mean()) if np.isfinite(least).any() else 1.0


def _points_at(camera: Camera, depth: np.ndarray, step: int) -> np.ndarray:
    """Return the world points [h, w, 3] of every `step`-th pixel at depths [h, w]."""
    rows, columns = np.mgrid[: camera.height : step, : camera.width : step]
    return camera.unproject(np.stack([columns, rows], axis=-1) + 0.5, depth)


def _squares(color: np.ndarray, points: np.ndarray, is_drawn: np.ndarray, view: View) -> np.ndarray:
    """Return the square differences [H, W] of colours from a view of their points [H, W, 3];
    infinite outside it.
    """
    pixels, visible = _places_in(view, points)
    visible &= is_drawn
    x, y = (pixels - 0.5).astype(np.float32).transpose(2, 0, 1)
    recorded = cv2.remap(view.image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(visible, ((unit_values(recorded) - color) ** 2).mean(axis=-1), np.inf)


def _places_in(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel positions [H, W, 2] of points [H, W, 3] in a view, 0 outside it, and the
    mask of the points that it has recorded.
    """
    camera = view.camera
    with np.errstate(divide="ignore", invalid="ignore"):  # points beside the camera
        pixels, depths = camera.project(points)
    visible = (depths > camera.near) & in_image(camera, pixels)
    pixels = np.where(visible[..., None], pixels, 0)
    if view.mask is not None:
        columns, rows = pixels.astype(int).transpose(2, 0, 1)
        visible &= view.mask[rows, columns]
    return pixels, visible

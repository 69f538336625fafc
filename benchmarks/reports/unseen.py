"""Forecast of views between the cameras, as `fit` prints it, on scenes that its regression has not
seen.

    python -m benchmarks.reports.unseen --captures sets/fern sets/flower rigs/walk4 clips/random-401
    --json unseen.json

Each capture is a folder of photos with the model of `morgs-mi calibrate`, a recording, or a clip of
`morgs-mi synth`. A share of the cameras, spread over the rig, is trained on in the first frame, and
the others are held out; of six cameras and fewer, each one in turn.

The regression of `morgs_mi.fit.unseen_views` is `regression_of` the rows of all runs, and the pages
have the forecasts of each capture by regressions without its rows, `out_of_capture`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.reports.fits import new_loop, spread_views
from benchmarks.reports.plots import Column, grouped, scores_table
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi import Gaussians
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.core.progress import Progress
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import forecast
from morgs_mi.fit.unseen_views import REGRESSION, WIDEST_REACH, Regression, features_of
from morgs_mi.fit.view import View, mean_psnr, rendered
from morgs_mi.loop.observation import Setup
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.exposure import Exposure, fit_exposure
from morgs_mi.runs.cluster.tasks import Source
from morgs_mi.runs.fit_capture import with_points

# Penalty of the standardised slopes, in captures.
_RIDGE = 1.0
# Share of the fits whose held-out views have their mean in the interval.
_HELD = 0.9
# Most cameras of which each is held out in turn.
_FEW = 6
# Most held-out views of a fit that are measured.
_MOST_VIEWS = 6

COLUMNS = (
    Column("training views", "training", 1, unit=" dB", spread=False),
    Column("held-out views", "mean", 1, unit=" dB", spread=False),
    Column("forecast", "forecast", 1, unit=" dB", spread=False),
    Column("interval", "width", 1, unit=" dB", spread=False),
    Column("fits in it", "within", 0, 100, " %", spread=False),
)


@dataclass(frozen=True)
class Options(StudyOptions):
    """Captures, work and output."""

    captures: tuple[Path, ...] = ()
    """Folders of photos, recordings or clips."""
    kind: str = "rigs"
    """Kind of the captures, by which pages group them."""
    width: int = 320
    """Width to which the images are reduced, px."""
    gaussians: int = 6000
    """Number of Gaussians."""
    steps: int = 500
    """Steps of the first frame."""
    exposure: Literal["off", "auto"] = "off"
    """Balance of the cameras' exposures."""
    shares: tuple[float, ...] = (0.8, 0.4)
    """Shares of the cameras that are trained on."""

    def study(self) -> Study:
        """Return the study of the captures."""
        scenes = []
        for path in self.captures:
            full = load_capture(path, test_view=None)
            capture = load_capture(path, max(1.0, full.cameras[0].width / self.width), None)
            for number, test in enumerate(held_out(capture, self.shares)):
                keys = {
                    "kind": self.kind,
                    "set": path.name,
                    "gaussians": self.gaussians,
                    "fit": number,
                }
                scenes.append(Scene(keys, (Source.of(capture.holding_out(test)),)))
        fit = FitConfig(
            num_gaussians=self.gaussians, first_frame_steps=self.steps, exposure=self.exposure
        )
        return Study(measure, scenes, [Variant({}, StreamConfig(fit))], self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the forecasts of each capture by the regression of the package, which may have
        seen it.
        """
        return scores_table(
            [forecast_row(row, REGRESSION) for row in rows], {"set": "set"}, COLUMNS
        )


def held_out(capture: Capture, shares: Sequence[float]) -> list[list[int]]:
    """Return which views are held out in each fit."""
    count = len(capture.cameras)
    if count <= _FEW:
        return [[view] for view in range(count)]
    every = range(count)
    train_sets = [spread_views(capture.cameras, round(share * count), every) for share in shares]
    return [[view for view in every if view not in views] for views in train_sets]


def measure(source: Source, config: StreamConfig) -> dict[str, Any]:
    """Fit the training views; return the features of the fit and the PSNR of held-out views."""
    capture = with_points(source.open(), config.seed, Progress())
    images = next(capture.frames(0, 1)).images
    loop = new_loop(capture, config)
    _, report = loop.push([images[view] for view in capture.train_views])
    assert loop.gaussians is not None
    return row_of(capture, images, loop.gaussians, loop.setup, report.exposures)


def row_of(
    capture: Capture,
    images: Sequence[np.ndarray],
    gaussians: Gaussians,
    setup: Setup,
    exposures: Sequence[Exposure],
) -> dict[str, Any]:
    """Return the row of a fit; held-out views are compared in the colours of the scene if it is
    balanced.
    """
    is_balanced = any(exposure != Exposure() for exposure in exposures)
    views = [View(*view) for view in zip(capture.cameras, images, capture.masks, strict=True)]
    train = [views[index] for index in capture.train_views]
    test = [
        views[index] for index in capture.test_views[:: -(-len(capture.test_views) // _MOST_VIEWS)]
    ]
    render = setup.config.render
    if is_balanced:
        pairs = zip(train, exposures, strict=True)
        train = [view._replace(image=exposure.corrected(view.image)) for view, exposure in pairs]
        fits = [
            fit_exposure(rendered(gaussians, view.camera, render), view.image / 255, view.mask)
            for view in test
        ]
        test = [
            view._replace(image=exposure.corrected(view.image))
            for view, exposure in zip(test, fits, strict=True)
        ]
    rig = forecast([view.camera for view in train], setup.points)
    features = features_of(gaussians, train, setup.points, render)
    psnrs = [mean_psnr(gaussians, [view], render) for view in test]
    return {"views": rig.cameras, "reach": rig.reach, "features": list(features), "held_out": psnrs}


def regression_of(rows: Sequence[Row]) -> Regression:
    """Return the regression of the loss on the features, with the interval from captures that it
    has not seen.

    Rigs that are too wide do not count, because `fit` prints the word alone.
    """
    rows = _near(rows)
    errors = []
    for (name,), group in grouped(rows, "set").items():
        others = _regression([row for row in rows if row["set"] != name])
        ratios = [
            abs(_loss(row) - others.loss(row["features"])) / others.scale(row["features"])
            for row in group
        ]
        errors.append(np.array(ratios))
    return _regression(rows, _conformal(errors))


def out_of_capture(rows: Sequence[Row]) -> Iterator[dict[str, Any]]:
    """Yield the rows of rigs that are not too wide, with forecasts by regressions without the rows
    of their capture.
    """
    for (name,), group in grouped(_near(rows), "set").items():
        regression = regression_of([row for row in rows if row["set"] != name])
        for row in group:
            yield forecast_row(row, regression)


def forecast_row(row: Row, regression: Regression) -> dict[str, Any]:
    """Return a row with its forecast by a regression."""
    training = row["features"][1]
    loss = regression.loss(row["features"])
    margin = regression.margin(row["features"])
    scores = {"training": training, "mean": training - _loss(row), "forecast": training - loss}
    return {**row, **scores, "width": 2 * margin, "within": abs(_loss(row) - loss) <= margin}


def _near(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of rigs that are not too wide for a number."""
    return [row for row in rows if row["reach"] <= WIDEST_REACH]


def _regression(rows: Sequence[Row], spread: float = 0.0) -> Regression:
    """Return the ridge regression of the loss, in which every capture has the same weight."""
    X = np.array([row["features"] for row in rows])
    y = np.array([_loss(row) for row in rows])
    sizes = {name: len(group) for (name,), group in grouped(rows, "set").items()}
    weights = np.array([1 / sizes[row["set"]] for row in rows])
    mean = weights @ X / len(sizes)
    middle = weights @ y / len(sizes)
    deviation = np.sqrt(weights @ (X - mean) ** 2 / len(sizes))
    Z = (X - mean) / deviation
    normal = (Z.T * weights) @ Z + _RIDGE * np.eye(len(mean))
    slopes = np.linalg.solve(normal, (Z.T * weights) @ (y - middle)) / deviation
    intercept = float(middle - mean @ slopes)
    return Regression(intercept, _pair(slopes), _pair(X.min(axis=0)), _pair(X.max(axis=0)), spread)


def _pair(values: np.ndarray) -> tuple[float, float]:
    """Return two values as floats."""
    disagreement, psnr = map(float, values)
    return disagreement, psnr


def _loss(row: Row) -> float:
    """Return the mean loss of the held-out views of a fit, dB."""
    return row["features"][1] - float(np.mean(row["held_out"]))


def _conformal(errors: Sequence[np.ndarray]) -> float:
    """Return the error below which nine fits in ten of an unseen capture are, where all captures
    count the same.

    This is rank 0.9 (m + 1) of the errors of m captures, of which each has the weight of one.
    """
    values = np.concatenate(errors)
    weights = np.concatenate([np.full(len(group), 1 / len(group)) for group in errors])
    order = values.argsort()
    is_enough = weights[order].cumsum() >= _HELD * (len(errors) + 1) - 1e-9
    return float(values[order][is_enough.argmax()]) if is_enough.any() else float("inf")


if __name__ == "__main__":
    tyro.cli(Options).run()

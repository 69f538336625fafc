"""Few cameras far apart: each camera of a recording held out in turn, by the start of the fit.

    python -m benchmarks.reports.far_cameras --capture walk4 --json far_cameras.json

The first frame is fitted to the other cameras and compared with the image of the held-out one, in
all pixels and in the silhouette of a person, whose outlines a file has. "Nearest photo" copies the
image of the nearest other camera, "one colour" is the mean of the others. "Random points" are at
the depths at which most views agree, "found" is the start of `fit_gaussians`.

"Silhouettes" uses silhouettes of the fitted views: a room is fitted without the person, and the
person alone, from points of their visual hull, before random colours. The number is the weight of
the difference of its opacity and the silhouettes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.pages.results import RESULTS
from benchmarks.reports.plots import grouped, markdown, span
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi import Gaussians, StreamConfig, fit_gaussians, load_capture, rasterize
from morgs_mi.capture.capture import Capture
from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.color_space import unit_values
from morgs_mi.core.gaussians import at_rest
from morgs_mi.core.rig import Focus, scene_extent
from morgs_mi.core.types import Tensors
from morgs_mi.core.view import View, Views
from morgs_mi.evaluate.comparison import nearest_views
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.far_views import PointCloud
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import from_points, mean_color, seed_points
from morgs_mi.fit.optimise import FINAL_RATE, Steps, adam, optimise, values_of, view_order
from morgs_mi.fit.view import rendered, seen_pixels
from morgs_mi.loop.first_frame import FittedImages
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.checks import valid_pixels

SCORES = {"held out, dB": "psnr", "person, dB": "psnr_person"}
# Random points, of which a fit takes as many as it needs.
_POINTS = 10_000
# Points of the person, and the random ones among which they are searched.
_HULL = 2_000
_CANDIDATES = 1_000_000
# Radius around the focus of the rig in which they lie, in mean distances of the cameras.
_RADIUS = 0.4
_WEIGHTS = (0.0, 0.1, 1.0)


@dataclass(frozen=True)
class Options(StudyOptions):
    """Recording, work and output."""

    capture: Path = Path("walk4")
    """Folder of the recording."""
    silhouettes: Path = RESULTS / "walk4_person.json"
    """JSON file with the outline of the person by camera, in pixels of the recorded images."""
    fit_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the fits of each held-out camera."""
    downscale: float = 8
    """Factor by which the images are downscaled."""
    gaussians: int = 4000
    """Number of Gaussians."""
    steps: int = 300
    """Steps of the first frame, and of the person alone."""

    def study(self) -> Study:
        """Return the study of the cameras, one held out in each scene."""
        capture = load_capture(self.capture, self.downscale, None)
        person = silhouettes(capture, read_json(self.silhouettes)["silhouettes"])
        fit = FitConfig(num_gaussians=self.gaussians, first_frame_steps=self.steps)
        return Study(
            measure,
            [Scene({"view": name}, (capture.holding_out(name), person)) for name in capture.names],
            [Variant({}, StreamConfig(fit))],
            self.fit_seeds,
        )

    def table(self, rows: Sequence[Row]) -> str:
        """Return the means over the cameras by start, with the range of the cameras."""
        lines = []
        for (start,), fits in grouped(rows, "start").items():
            lines.append((start, *(over_cameras(fits, score) for score in SCORES.values())))
        return markdown(("start", *SCORES), lines)


def over_cameras(rows: Sequence[Row], score: str) -> str:
    """Return the mean of a score over the cameras, and the range of their means over the seeds."""
    cameras = grouped(rows, "view").values()
    means = [float(np.mean([row[score] for row in fits])) for fits in cameras]
    return f"{np.mean(means):.1f} ({span(means)})"


def silhouettes(
    capture: Capture, outlines: Mapping[str, Sequence[Sequence[int]]]
) -> dict[str, np.ndarray]:
    """Return the pixels [H, W] of a capture's views inside of outlines, by camera; outlines [P, 2]
    are in pixels of the recorded images.
    """
    masks = {}
    for view in capture.views:
        width, height = view.at_recorded_size().camera.size
        recorded = np.zeros((height, width), np.float32)
        cv2.fillPoly(recorded, [np.array(outlines[view.name], np.int32)], [1.0])
        share = cv2.resize(recorded, view.camera.size, interpolation=cv2.INTER_AREA)
        masks[view.name] = share > 0.5
    return masks


def measure(
    capture: Capture, person: Mapping[str, np.ndarray], config: StreamConfig
) -> list[dict[str, Any]]:
    """Return the scores of the held-out view of a capture from each start."""
    views = next(capture.frames(0, 1)).views
    people = Views(within(view, person[view.name]) for view in views)
    (nearest,) = nearest_views(capture, capture.cameras).values()
    points = seed_points(views.train, _POINTS, np.random.default_rng(config.seed))
    room = fitted([within(view, ~person[view.name]) for view in views.train], config)
    fits = {"random points": fitted(views.train, config, *points)}
    fits["found"] = fitted(views.train, config)
    for weight in _WEIGHTS:
        alone = person_alone(people.train, weight, config)
        parts = [at_rest(room.gaussians), at_rest(alone)]
        name = f"silhouettes, {weight:g}"
        fits[name] = replace(room, gaussians=Gaussians.concatenate(parts))
    images = {
        "nearest photo": partial(resized, views[nearest].image),
        "one colour": partial(filled, mean_color(views.train)),
        **{start: partial(drawn, fit) for start, fit in fits.items()},
    }
    return [{"start": start, **scores(views, people, image)} for start, image in images.items()]


def within(view: View, mask: np.ndarray) -> View:
    """Return a view of which only the pixels of a mask [H, W] are valid."""
    return replace(view, mask=mask & valid_pixels(view.mask, mask.shape))


def resized(image: np.ndarray, view: View) -> np.ndarray:
    """Return an image at the size of a view."""
    return cv2.resize(image, view.camera.size)


def filled(color: Sequence[float], view: View) -> np.ndarray:
    """Return an image of one colour at the size of a view."""
    return np.full(view.image.shape, color)


def drawn(fit: FittedImages, view: View) -> np.ndarray:
    """Return the image of a fit in a view."""
    return rendered(fit.gaussians, view.camera, fit.render)


def scores(
    views: Views[View], people: Views[View], image: Callable[[View], np.ndarray]
) -> dict[str, float]:
    """Return the PSNR of the held-out view, of the person in it, and the mean of the others."""
    (test,) = views.test
    (person,) = people.test
    train = [psnr(image(view), view.image, view.mask) for view in views.train]
    return {
        "psnr": psnr(image(test), test.image, test.mask),
        "psnr_person": psnr(image(test), test.image, person.mask),
        "train_psnr": float(np.mean(train)),
    }


def fitted(views: Sequence[View], config: StreamConfig, *points: np.ndarray) -> FittedImages:
    """Return the fit of the first frame to views, from points and their colours or without."""
    return fit_gaussians(views, [view.image for view in views], *points, config=config)


def person_alone(people: Sequence[View], weight: float, config: StreamConfig) -> Gaussians:
    """Return Gaussians fitted to the valid pixels of views before random colours.

    Args:
        people: the views, in which the person is valid.
        weight: of the difference of the opacity and the silhouette in each pixel.
        config: of the seed, the steps and the rates, and of the spherical harmonics, of which only
            the constant one is fitted.
    """
    rng = np.random.default_rng(config.seed)
    start = from_points(*hull_points(people, rng), config.fit.sh_degree)
    parameters = dict(start.parameters())
    frozen = {name: parameters.pop(name, None) for name in ("sh_rest", "logit_confidence")}
    masks = [valid_pixels(view.mask, view.image.shape)[..., None] for view in people]
    steps = config.fit.planned_steps

    def losses_at(values: Tensors, index: int) -> Tensors:
        view = people[index]
        background = rng.uniform(size=3)
        mask = masks[index]
        target = np.where(mask, unit_values(view.image), background)
        image = rasterize(start.with_parameters(dict(values)), view.camera, background=background)
        return {
            "color": dr.mean(dr.abs(image.color - from_numpy(mi.TensorXf, target)), axis=None),
            "alpha": dr.mean(dr.abs(image.alpha - from_numpy(mi.TensorXf, mask)), axis=None),
        }

    optimizer = adam(parameters)
    rates = config.fit.first_frame_rates.by_parameter(scene_extent([v.camera for v in people]))
    order = Steps(
        view_order(len(people), steps, rng), rate_factor=lambda step: FINAL_RATE ** (step / steps)
    )
    optimise(optimizer, rates, losses_at, order, {"alpha": weight})
    return start.with_parameters({**values_of(optimizer), **frozen})


def hull_points(people: Sequence[View], rng: np.random.Generator) -> PointCloud:
    """Return random points that all views show in valid pixels, and their mean colours."""
    cameras = [view.camera for view in people]
    focus = Focus.of(cameras)
    radius = _RADIUS * float(np.mean([focus.depth(camera) for camera in cameras]))
    points = focus.point + radius * rng.uniform(-1, 1, (_CANDIDATES, 3))
    for view in people:
        visible, pixels = seen_pixels(view.camera, points)
        points = points[visible][valid_pixels(view.mask, view.image.shape)[pixels]]
    points = points[:_HULL]
    colors = [unit_values(view.image[seen_pixels(view.camera, points)[1]]) for view in people]
    return PointCloud(points, np.mean(colors, axis=0))


if __name__ == "__main__":
    tyro.cli(Options).run()

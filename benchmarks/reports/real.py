"""Real images: held-out views over the time of the first frame, and from the cameras that fit their
images best.

    python -m benchmarks.reports.real --captures sets/fern sets/flower --json out.json python -m
    benchmarks.reports.real --captures sets/fern sets/flower --seconds 60 120 300 --width 720 --json
    out.json

Each capture is a folder of photos with the model of `morgs-mi calibrate`, or a recording. Views 5,
13, 21 and so on are held out. A capture with few points starts from those that `morgs-mi fit` finds
in its training views.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro

from benchmarks.reports.fits import new_loop
from benchmarks.reports.plots import Column, scores_table
from benchmarks.reports.registration import register_camera
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi import Gaussians, RenderConfig, rasterize
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.core.camera import Camera
from morgs_mi.core.view import View
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import mean_psnr
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.platform.progress import Progress
from morgs_mi.playback.visualise import label, side_by_side
from morgs_mi.runs.fit_capture import with_points

COLUMNS = (
    Column("held out, dB", "held_out"),
    Column("registered, dB", "registered"),
)
_FIRST = 4
_EVERY = 8


@dataclass(frozen=True)
class Options(StudyOptions):
    """Captures, work and output."""

    captures: tuple[Path, ...] = ()
    """Folders of photos, or recordings."""
    width: int = 360
    """Width to which the images are reduced, px."""
    gaussians: int = 20_000
    """Number of Gaussians."""
    steps: int = 1200
    """Steps of the first frame."""
    seconds: tuple[int, ...] = ()
    """Times of the first frame, which plan its Gaussians and steps instead."""
    pictures: Path | None = None
    """Folder for a picture of each set, SET.jpg: the first held-out image, recorded and rendered.
    """

    def study(self) -> Study:
        """Return the study of the captures."""
        scenes = []
        for path in self.captures:
            full = load_capture(path, test_view=None)
            capture = load_capture(path, max(1.0, full.cameras[0].width / self.width), None)
            keys = {
                "set": path.name.partition("-")[0],
                "principal_points": principal_points(capture.cameras),
            }
            test = list(range(_FIRST, len(full.cameras), _EVERY))
            args = capture.holding_out(test), self.pictures
            scenes.append(Scene(keys | {"test": test}, args))
        settings = FitConfig(num_gaussians=self.gaussians, first_frame_steps=self.steps)
        fits = {seconds: FitConfig(first_frame_seconds=seconds) for seconds in self.seconds} or {
            None: settings
        }
        variants = [
            Variant({"seconds": seconds}, StreamConfig(fit)) for seconds, fit in fits.items()
        ]
        return Study(measure, scenes, variants, self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the scores by set, calibration and time of the first frame."""
        keys = {"photos": "set", "principal points": "principal_points", "may take, s": "seconds"}
        return scores_table(rows, keys, COLUMNS, left=2)


def principal_points(cameras: Sequence[Camera]) -> str:
    """Return whether cameras have equal principal points, in image sizes: ``"shared"`` or
    ``"own"``.
    """
    points = {(round(c.K[0, 2] / c.width, 6), round(c.K[1, 2] / c.height, 6)) for c in cameras}
    return "own" if len(points) > 1 else "shared"


def measure(capture: Capture, pictures: Path | None, config: StreamConfig) -> dict[str, Any]:
    """Fit the views that are not held out; return the mean PSNR of both, of the held-out ones in
    both ways.
    """
    capture = with_points(capture, config.seed, Progress())
    frame = next(capture.frames(0, 1))
    train = frame.train
    test = frame.test
    loop = new_loop(capture, config)
    start = time.process_time()
    _, report = loop.push(train)
    seconds = time.process_time() - start
    gaussians = loop.gaussians
    assert gaussians is not None
    extent = loop.setup.extent
    render = loop.setup.config.render  # with the background that the fit has found
    cameras = [register_camera(gaussians, view, extent, config.fit, render) for view in test]
    groups = {
        "training": train,
        "held_out": test,
        "registered": [
            replace(view, camera=camera) for view, camera in zip(test, cameras, strict=True)
        ],
    }
    if pictures is not None:
        path = pictures / f"{capture.path.name}.jpg"
        _write_picture(path, gaussians, test[0], render)
    scores = {name: mean_psnr(gaussians, group, render) for name, group in groups.items()}
    return scores | {
        "views": len(train),
        "held_out_views": len(test),
        "gaussians": len(gaussians),
        "steps": report.steps,
        "cpu_s": seconds,
    }


def _write_picture(path: Path, gaussians: Gaussians, view: View, render: RenderConfig) -> None:
    """Write a recorded image and its rendering side by side."""
    image = np.asarray(rasterize(gaussians, view.camera, ("color",), config=render).color)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = side_by_side([label(view.image, "held-out image"), label(image, "rendered")])
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    tyro.cli(Options).run()

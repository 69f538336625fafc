"""Refinement of disturbed cameras: poses and focal lengths that are found again, and the quality
that comes back.

    python -m benchmarks.reports.cameras --seeds 3 6 7 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`. Every camera is rotated by
an angle about a random axis, displaced by as many per cent of the scene extent in a random
direction, and given focal lengths that are 1 % too long or too short; at 0 degrees, all cameras are
true. The first frame is fitted with the true cameras, the wrong and the refined ones. The held-out
view is scored as calibrated, and registered: seen from the camera that fits its image best.

With `--lens`, cameras are also refined that are true but for their lenses: the training views have
a radial distortion of up to that (k1), of which the calibration knows nothing.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro

from benchmarks.reports.fits import new_loop, random_capture, synthetic
from benchmarks.reports.plots import grouped, markdown, span
from benchmarks.reports.registration import register_camera
from benchmarks.reports.study import Row, Scene, Study, StudyOptions, Variant
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.layouts.calibration import CalibratedImage
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.lens import Lens
from morgs_mi.core.camera import Camera
from morgs_mi.core.rig import scene_extent
from morgs_mi.extras.calibration.bundle import changed_camera
from morgs_mi.extras.calibration.refine import refine_cameras
from morgs_mi.extras.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.view import mean_psnr
from morgs_mi.loop.stream_config import StreamConfig

_FOCAL_ERROR = 0.01
_RIGS = "true", "disturbed", "refined"


@dataclass(frozen=True)
class Options(StudyOptions):
    """Clips, disturbances and output."""

    seeds: tuple[int, ...] = (3, 6, 7)
    """Seeds of the scenes."""
    degrees: tuple[float, ...] = (0.5, 1.0, 0.2)
    """Rotations of the cameras; their displacements in per cent of the scene extent."""
    disturbances: tuple[int, ...] = (0, 1, 2)
    """Seeds of the disturbances."""
    lens: float = 0.0
    """Largest distortion of lenses that the calibration denies; 0: none."""
    clips: Path = Path("out/random")
    """Folder of the clips, which are made where they are missing."""
    downscale: float = 1
    """Factor by which the clips are reduced."""
    gaussians: int = 4000
    """Number of Gaussians."""
    steps: int = 600
    """Steps of the first frame."""

    def study(self) -> Study:
        """Return the study of the disturbances."""
        scenes = []
        for seed in self.seeds:
            capture = random_capture(self.clips, seed, self.downscale)
            for disturbance, degrees in product(self.disturbances, self.degrees):
                keys = {"seed": seed, "degrees": degrees, "disturbance": disturbance, "lens": 0.0}
                scenes.append(Scene(keys, (capture, capture, degrees, disturbance)))
            if self.lens:
                true, denied = (load_capture(c, self.downscale) for c in lens_clips(self, seed))
                keys = {"seed": seed, "degrees": 0.0, "disturbance": 0, "lens": self.lens}
                scenes.append(Scene(keys, (true, denied, 0.0, 0)))
        fit = FitConfig(
            num_gaussians=self.gaussians,
            first_frame_steps=self.steps,
            dropout=0.0,
            refine_cameras="auto",
        )
        return Study(measure, scenes, [Variant({}, StreamConfig(fit))], self.fit_seeds)

    def table(self, rows: Sequence[Row]) -> str:
        """Return the registered PSNR, its recovered share and the errors of the rotations by the
        error of the rig.
        """
        groups = {
            f"poses off by {degrees:g} degrees": group
            for (degrees,), group in sorted(
                grouped((row for row in rows if not row["lens"]), "degrees").items()
            )
        }
        groups["lenses ignored"] = [row for row in rows if row["lens"]]
        lines = []
        for name, group in groups.items():
            if not group:
                continue
            psnrs = (f"{np.mean([row[rig]['registered'] for row in group]):.1f}" for rig in _RIGS)
            shares = []
            for row in group:
                best, worst, result = (row[rig]["registered"] for rig in _RIGS)
                is_lost = (row["degrees"] or row["lens"]) and best != worst
                shares.append(100 * (result - worst) / (best - worst) if is_lost else np.nan)
            lines.append(
                (
                    name,
                    *psnrs,
                    f"{span(shares, 0)} %",
                    span((row["refined"]["rotation"] for row in group), 2),
                )
            )
        titles = "true cameras, dB", "disturbed", "refined", "recovered", "rotation after, degrees"
        return markdown(("error", *titles), lines)


def disturbed(cameras: Sequence[Camera], degrees: float, seed: int) -> tuple[Camera, ...]:
    """Return cameras with wrong poses and focal lengths."""
    rng = np.random.default_rng([seed, 7])
    extent = scene_extent(cameras)
    result = []
    for camera in cameras:
        axis, direction = rng.normal(size=(2, 3))
        rotation = np.deg2rad(degrees) * axis / np.linalg.norm(axis)
        displacement = degrees / 100 * extent * direction / np.linalg.norm(direction)
        change = [*rotation, *displacement, _FOCAL_ERROR * rng.choice([-1, 1]), 0, 0]
        result.append(changed_camera(camera, np.array(change)))
    return tuple(result)


def rotation_error(rig: Capture, true: Capture) -> float:
    """Return the mean error of the rotations of the training cameras after the best common one,
    degrees.
    """
    pairs = [
        (rig.cameras[v].viewmat[:3, :3], true.cameras[v].viewmat[:3, :3]) for v in true.train_views
    ]
    U, _, Vt = np.linalg.svd(sum(a.T @ b for a, b in pairs))
    turns = [cv2.Rodrigues(a @ U @ Vt @ b.T)[0] for a, b in pairs]
    return float(np.rad2deg([np.linalg.norm(turn) for turn in turns]).mean())


def scores(capture: Capture, config: StreamConfig) -> dict[str, float]:
    """Fit the first frame; return the PSNR of the held-out view in both ways."""
    loop = new_loop(capture, config)
    frame = next(capture.frames(0, 1))
    loop.push(frame.train)
    gaussians = loop.gaussians
    assert gaussians is not None
    view = frame.views[capture.reference_view]
    camera = register_camera(gaussians, view, loop.setup.extent, config.fit, config.render)
    views = {"calibrated": view, "registered": replace(view, camera=camera)}
    return {name: mean_psnr(gaussians, [each], config.render) for name, each in views.items()}


def measure(
    capture: Capture, wrong: Capture, degrees: float, disturbance: int, config: StreamConfig
) -> dict[str, Any]:
    """Return the scores with true, wrong and refined cameras, and the errors of the cameras.

    Args:
        capture: the recording with its true cameras.
        wrong: the same with the lenses of a calibration.
        degrees: rotation of the cameras.
        disturbance: seed of the disturbance.
        config: settings.
    """
    if degrees:
        wrong = wrong.with_cameras(disturbed(wrong.cameras, degrees, disturbance))
    better, refinement = refine_cameras(wrong, config.fit, config.render, config.seed)
    return {
        "true": scores(capture, config),
        "disturbed": scores(wrong, config) | {"rotation": rotation_error(wrong, capture)},
        "refined": scores(better, config) | {"rotation": rotation_error(better, capture)},
        "refinement": asdict(refinement),
    }


def lens_clips(options: Options, seed: int) -> tuple[Path, Path]:
    """Return a clip through lenses with distortion, and a copy with a calibration without it for
    the training views.
    """
    path = options.clips / f"random-{seed}-lens-{options.lens:g}"
    denied = path.with_name(f"{path.name}-denied")
    disturbances = Disturbances(distortion=options.lens)
    capture = synthetic("random", path, SynthConfig(frames=1, seed=seed, disturbances=disturbances))
    if not denied.exists():
        truth = load_disturbances(path / "truth")
        images = [
            CalibratedImage(view.camera, truth[view.name].lens if view.held_out else Lens())
            for view in capture.views
        ]
        shutil.copytree(path, denied)
        write_colmap(denied / "sparse" / "0", images, capture.points, capture.point_colors)
    return path, denied


if __name__ == "__main__":
    tyro.cli(Options).run()

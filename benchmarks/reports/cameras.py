"""Refinement of disturbed cameras: poses and focal lengths that are found again, and the quality that comes back.

    python -m benchmarks.reports.cameras --seeds 3 6 7 --json out.json

Each clip is `morgs-mi synth random --seed SEED`, as in `random_scenes`. Every camera is rotated by an angle about a
random axis, displaced by as many per cent of the scene extent in a random direction, and given focal lengths that are
1 % too long or too short; at 0 degrees, all cameras are true. The first frame is fitted with the true cameras, the
disturbed and the refined ones. The held-out view is scored as calibrated, and registered: seen from the camera that
fits its image best.

With `--lens`, cameras are also refined that are true but for their lenses: the training views have a radial distortion
of up to that (k1), of which the calibration knows nothing.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.reports.cells import CellOptions
from benchmarks.reports.fits import new_loop, random_capture
from morgs_mi.calibration.bundle import changed_camera, distorted
from morgs_mi.calibration.refine import refine_cameras, register_camera
from morgs_mi.capture.capture import Capture, load_capture
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.lens import Lens
from morgs_mi.cluster.tasks import Source
from morgs_mi.config import StreamConfig
from morgs_mi.core.camera import Camera
from morgs_mi.fit.initialise import scene_extent
from morgs_mi.fit.view import View, mean_psnr
from morgs_mi.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.synth.synth_config import SynthConfig
from morgs_mi.synth.synthesize import synthesize

_FOCAL_ERROR = 0.01


@dataclass(frozen=True)
class Options(CellOptions):
    """Clips, disturbances and output."""

    seeds: tuple[int, ...] = (3, 6, 7)
    """Seeds of the scenes."""
    clips: Path = Path("out/random")
    """Folder of the clips."""
    degrees: tuple[float, ...] = (0.5, 1.0, 0.2)
    """Rotations of the cameras; their displacements in per cent of the scene extent."""
    disturbances: tuple[int, ...] = (0, 1, 2)
    """Seeds of the disturbances."""
    lens: float = 0.0
    """Largest distortion of lenses that the calibration denies; 0: none."""
    downscale: float = 1
    """Factor by which the clips are reduced."""
    steps: int = 600
    """Steps of the first frame."""
    gaussians: int = 4000
    """Number of Gaussians."""


def disturbed(cameras: Sequence[Camera], degrees: float, seed: int) -> tuple[Camera, ...]:
    """Return cameras with wrong poses and focal lengths."""
    rng, extent, found = np.random.default_rng([seed, 7]), scene_extent(cameras), []
    focal = _FOCAL_ERROR if degrees else 0.0
    for camera in cameras:
        axis, direction = rng.normal(size=(2, 3))
        rotation = np.deg2rad(degrees) * axis / np.linalg.norm(axis)
        displacement = degrees / 100 * extent * direction / np.linalg.norm(direction)
        found.append(changed_camera(camera, np.array([*rotation, *displacement, focal * rng.choice([-1, 1]), 0, 0])))
    return tuple(found)


def pose_errors(cameras: Sequence[Camera], true: Sequence[Camera]) -> dict[str, float]:
    """Return the errors of cameras after the best common rotation, displacement and scale: degrees, extents, ratio."""
    centres, goals = (np.array([camera.position for camera in rig]) for rig in (cameras, true))
    centres, goals = centres - centres.mean(axis=0), goals - goals.mean(axis=0)
    pairs = list(zip(cameras, true, strict=True))
    U, _, Vt = np.linalg.svd(sum(a.viewmat[:3, :3].T @ b.viewmat[:3, :3] for a, b in pairs))
    centres = centres @ (U @ Vt)
    centres *= (centres * goals).sum() / (centres**2).sum()
    turns = [cv2.Rodrigues(a.viewmat[:3, :3] @ U @ Vt @ b.viewmat[:3, :3].T)[0] for a, b in pairs]
    degrees = np.rad2deg([np.linalg.norm(turn) for turn in turns])
    return {
        "rotation": round(float(degrees.mean()), 4),
        "worst_rotation": round(float(degrees.max()), 4),
        "position": round(float(np.linalg.norm(centres - goals, axis=1).mean() / scene_extent(true)), 5),
        "focal": round(float(np.mean([abs(a.K[0, 0] / b.K[0, 0] - 1) for a, b in pairs])), 5),
    }


def scores(capture: Capture, config: StreamConfig) -> dict[str, float]:
    """Fit the first frame; return the PSNR of the training views, and of the held-out one in both ways."""
    loop, images, train = new_loop(capture, config), next(capture.frames(0, 1)).images, capture.train_views
    loop.push([images[v] for v in train])
    gaussians, test = loop.gaussians, capture.test_view
    assert gaussians is not None
    assert test is not None
    view = View(capture.cameras[test], images[test], capture.masks[test])
    registered = register_camera(gaussians, view, loop.setup.extent, config.fit, config.render)
    views = {
        "training": [View(capture.cameras[v], images[v], capture.masks[v]) for v in train],
        "calibrated": [view],
        "registered": [view._replace(camera=registered)],
    }
    return {name: round(mean_psnr(gaussians, given, config.render), 2) for name, given in views.items()}


def measure_true(source: Source, config: StreamConfig) -> dict[str, Any]:
    """Return the scores with the true cameras."""
    return {"true": scores(source.open(), config)}


def measure(source: Source, degrees: float, seed: int, config: StreamConfig) -> dict[str, Any]:
    """Return the scores with disturbed and with refined cameras, and their errors."""
    capture = source.open()
    wrong = replace(capture, cameras=disturbed(capture.cameras, degrees, seed))
    better, found = refine_cameras(wrong, config.fit, config.render, config.seed)
    true, before, after = ([c.cameras[v] for v in capture.train_views] for c in (capture, wrong, better))
    return {
        "disturbed": scores(wrong, config) | pose_errors(before, true),
        "refined": scores(better, config) | pose_errors(after, true),
        "refinement": asdict(found),
    }


def lens_clips(clips: Path, seed: int, distortion: float) -> tuple[Path, Path]:
    """Return a clip through lenses with distortion, and a copy whose calibration denies it for the training views."""
    true = clips / f"random-{seed}-lens-{distortion:g}"
    denied = true.with_name(f"{true.name}-denied")
    if not denied.exists():
        own = Disturbances(distortion=distortion)
        synthesize("random", true, SynthConfig(frames=1, seed=seed, disturbances=own), overwrite=True)
        capture, truth = load_capture(true), load_disturbances(true / "truth")
        lenses = [truth[n].lens if v == capture.test_view else Lens() for v, n in enumerate(capture.names)]
        shutil.copytree(true, denied)
        write_colmap(denied / "sparse" / "0", capture.cameras, capture.points, capture.point_colors, lenses)
    return true, denied


def measure_lens(source: Source, denied: Source, config: StreamConfig) -> dict[str, Any]:
    """Return the scores with true, denied and refined lenses, and the errors of the cameras."""
    capture, wrong = source.open(), denied.open()
    better, found = refine_cameras(wrong, config.fit, config.render, config.seed)
    truth, none = load_disturbances(capture.path / "truth"), [(0.0, 0.0)] * len(capture.cameras)
    train = [(v, capture.cameras[v], truth[capture.names[v]].distortion) for v in capture.train_views]

    def about(given: Capture) -> dict[str, float]:
        terms = given.distortions or none
        corners = [_at_corner(given.cameras[v], terms[v]) - _at_corner(camera, (k, 0.0)) for v, camera, k in train]
        shift = float(np.mean(np.linalg.norm(corners, axis=1)))
        errors = pose_errors([given.cameras[v] for v in given.train_views], [camera for _, camera, _ in train])
        return scores(given, config) | errors | {"corner": round(shift, 3)}

    return {
        "true": scores(capture, config),
        "disturbed": about(wrong),
        "refined": about(better),
        "refinement": asdict(found),
    }


def _at_corner(camera: Camera, terms: Sequence[float]) -> np.ndarray:
    """Return by how much distortion shifts the first corner of an image, px."""
    corner = np.zeros((1, 2))
    return (distorted(camera, corner, np.asarray(terms)) - corner)[0]


def recovered(row: Mapping[str, Any]) -> float:
    """Return the share of the lost PSNR of the registered view that refinement brings back."""
    true, before, after = (row[name]["registered"] for name in ("true", "disturbed", "refined"))
    return round((after - before) / (true - before), 3)


def main(options: Options) -> None:
    """Run the report; the file is written after each disturbance."""
    mi.set_variant("llvm_ad_rgb")
    config = StreamConfig()
    fit = replace(config.fit, first_frame_steps=options.steps, num_gaussians=options.gaussians, dropping=0.0)
    config = replace(config, fit=replace(fit, refine_cameras="auto"))
    sources = {seed: Source.of(random_capture(options.clips, seed, options.downscale)) for seed in options.seeds}
    true = options.run(measure_true, {str(seed): (source, config) for seed, source in sources.items()})
    given = {"downscale": options.downscale, "steps": options.steps, "gaussians": options.gaussians}
    rows: list[dict[str, Any]] = []
    lenses: list[dict[str, Any]] = []
    if options.lens:
        clips = {str(seed): lens_clips(options.clips, seed, options.lens) for seed in options.seeds}
        pairs = {s: [Source.of(load_capture(path, options.downscale)) for path in pair] for s, pair in clips.items()}
        found = options.run(measure_lens, {seed: (*pair, config) for seed, pair in pairs.items()})
        lenses = [
            {"seed": int(s), "lens": options.lens, "recovered": recovered(row), **row} for s, row in found.items()
        ]
    for disturbance, degrees in product(options.disturbances, options.degrees):
        cells = {str(seed): (source, degrees, disturbance, config) for seed, source in sources.items()}
        for seed, row in options.run(measure, cells).items():
            about, row = {"seed": int(seed), "degrees": degrees, "disturbance": disturbance}, {**true[seed], **row}
            rows.append({**about, "recovered": recovered(row) if degrees else None, **row})
        options.write({**given, "fits": rows, "lenses": lenses}, unprinted=["fits", "lenses"])


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Calibration from clips alone: features, matches and mapping of one frame by pycolmap, stored as a
COLMAP model.

COLMAP keeps principal points in the middle of the images. Optical stabilisation moves the lens of a
phone from photo to photo, by up to 2 % of the image's width. A last bundle adjustment therefore
moves the principal points, one for each image, and is used if it fits clearly better.

The scale and the up direction of the model's world are arbitrary: images do not determine them.
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Lt

from morgs_mi.capture.capture_settings import read_settings
from morgs_mi.capture.layouts.clips import (
    EXAMPLE,
    clips_by_camera,
    find_clips,
    names_without,
    photos,
)
from morgs_mi.capture.masks import opaque_pixels
from morgs_mi.capture.timeline import nearest_frames
from morgs_mi.core.color_space import display_image, display_stops
from morgs_mi.core.types import Arrays
from morgs_mi.extras.calibration.checks.rig_check import CameraCheck, median
from morgs_mi.fit.image_points import MAX_ERROR
from morgs_mi.io.clip_readers import open_clips
from morgs_mi.platform.checks import few, require, valid_pixels
from morgs_mi.platform.config import check_ranges, config_or_default
from morgs_mi.platform.files import CAPTURE, atomic_path
from morgs_mi.platform.png import png_bytes
from morgs_mi.platform.progress import Report

Mapper = Literal["incremental", "global"]

# With fewer features in a view COLMAP cannot register it.
_MIN_FEATURES = 100
# Contrast of the weakest features. At COLMAP's 0.0067, views at the edge of a rig have too few
# matches for a pose.
_PEAK = 0.002
# COLMAP registers a camera with fewer points, but its pose then depends on a few of them.
_MIN_POINTS = 50
# Relative decrease of the median error from which images get principal points of their own. On
# photos by stabilised phones it is 0.26 and 0.28, on others at most 0.11.
_LEAST_DECREASE = 0.15
# Files in the folder that COLMAP works in.
_IMAGES = "images"
_MASKS = "masks"
_DATABASE = "database.db"
_MORE_TEXTURE = (
    "light the scene evenly, add textured objects, or record a frame with such objects before the "
    "take"
)


@dataclass(frozen=True)
class CalibrateConfig:
    """Settings of the calibration."""

    camera_model: Literal[
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "OPENCV_FISHEYE",
        "FULL_OPENCV",
    ] = "SIMPLE_RADIAL"
    """COLMAP camera model; one with more parameters needs more views, or shared intrinsics."""
    shared_intrinsics: bool = False
    """One set of intrinsics for all cameras of an image size, which needs fewer views; for equal
    make and zoom.
    """
    frame: int = 0
    """Frame to calibrate on; in clips of variable frame rate, the one nearest in time."""
    partial: bool = False
    """Accept a model that lacks some of the cameras."""
    # COLMAP takes no others.
    seed: Annotated[int, Ge(0), Lt(2**31)] = 0
    """Seed of COLMAP's random samples."""


@dataclass(frozen=True)
class CalibrationResult:
    """Result of `calibrate`."""

    model: Path  #: Folder of the COLMAP model.
    points: int  #: Number of points.
    error: float  #: Mean reprojection error of the points, px.
    #: Result of every camera, including the ones left out; `matches` is the number of its points.
    checks: tuple[CameraCheck, ...]
    mapper: Mapper  #: COLMAP's mapper of the model, ``"incremental"`` or ``"global"``.
    principal_points: bool  #: Whether each image has a principal point of its own.

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the calibrated cameras."""
        return tuple(check.name for check in self.checks if check.fits is not None)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the cameras that could not be calibrated."""
        return without_pose(self.checks)


@dataclass(frozen=True)
class Candidate:
    """A model of COLMAP."""

    mapper: Mapper  # the mapper that made it
    model: Any  # pycolmap's reconstruction
    checks: tuple[CameraCheck, ...]  # result of every camera, including the ones without a pose
    principal_points: bool = False  # whether each image has a principal point of its own

    @property
    def error(self) -> float:
        """Mean reprojection error of the points, px."""
        return float(self.model.compute_mean_reprojection_error())

    @property
    def rank(self) -> tuple[int, int, float]:
        """Number of cameras that fit, negative number of cameras without a pose, and the negative
        error; larger is better.
        """
        return (
            sum(check.fits is True for check in self.checks),
            -len(without_pose(self.checks)),
            -self.error,
        )


def without_pose(checks: Sequence[CameraCheck]) -> tuple[str, ...]:
    """Return the names of the cameras without a pose."""
    return tuple(check.name for check in checks if check.fits is None)


def import_pycolmap() -> Any:
    """Return the module pycolmap, and restore the signal handler of SIGTERM after its import.

    The logging library of pycolmap installs a handler for SIGTERM that prints a stack trace and
    aborts the process.
    """
    pycolmap = import_module("pycolmap")
    handler = signal.getsignal(signal.SIGTERM)  # as set in Python
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


def calibrate(
    path: str | Path,
    config: CalibrateConfig | None = None,
    overwrite: bool = False,
    progress: Report | None = None,
    without: Sequence[str] = (),
) -> CalibrationResult:
    """Calibrate a folder of clips, one per camera, and write ``sparse/0`` there; nothing is written
    on failure.

    Args:
        path: the folder: videos, a folder of images per camera, or one photo per camera.
        config: settings.
        overwrite: whether to replace an existing model.
        progress: called with (stage, done, total).
        without: names of the cameras to leave out.

    Raises:
        FileNotFoundError: there is no such folder.
        FileExistsError: there is a `sparse` folder and `overwrite` is not set.
        ValueError: fewer than two clips, clips that cannot be read, or views that do not determine
            the cameras; the message names them and suggests a remedy.
        OSError: the model cannot be written.
    """
    path = Path(path)
    config = config_or_default("calibrate()", config, CalibrateConfig())
    check_ranges(config, "calibrate()")
    report = progress or (lambda *_: None)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected a folder of clips, found none; check the path.")
    if (path / "sparse").exists() and not overwrite:
        raise FileExistsError(
            f"{path / 'sparse'}: expected no model, got one; remove it, or overwrite it "
            "(--overwrite)."
        )
    report("Reading frames", 0, 1)
    images, masks = _frames(path, config, without)
    report("Reading frames", 1, 1)
    with tempfile.TemporaryDirectory() as scratch, _quiet():
        match_views(path, images, masks, Path(scratch), config, report)
        report("Mapping", 0, 1)
        best = map_views(path, tuple(images), Path(scratch), config.seed)
        report("Mapping", 1, 1)
        result = CalibrationResult(
            path / "sparse" / "0",
            best.model.num_points3D(),
            best.error,
            best.checks,
            best.mapper,
            best.principal_points,
        )
        require(
            config.partial or not result.left_out,
            path,
            f"expected to register all {len(result.checks)} cameras",
            f"{len(result.cameras)}, without {', '.join(result.left_out)}",
            f"move these so that neighbours see the same objects, {_MORE_TEXTURE}, calibrate on "
            "another frame (--frame), or accept the partial model (--partial)",
        )
        # Images of a folder of photos are named after their files, which other programs open by
        # these names.
        files = {} if clips_by_camera(path) else photos(path)
        for image in _registered(best.model):
            if (name := Path(image.name).stem) in files:
                image.name = files[name][0].name
        with atomic_path(path / "sparse", "calibrate()") as folder:
            _write_model(best.model, folder / "0")
    return result


def _checks(model: Any, names: Sequence[str]) -> tuple[CameraCheck, ...]:
    """Return the result of each camera from its points in COLMAP's model."""
    images = {Path(image.name).stem: image for image in _registered(model)}
    return tuple(_check(name, images.get(name), model) for name in names)


def _registered(model: Any) -> list[Any]:
    """Return the images of a model."""
    return [model.image(i) for i in model.reg_image_ids()]


def _write_model(model: Any, folder: Path) -> None:
    """Write a model as text, and check its files: pycolmap does not report a full disk.

    Raises:
        OSError: a file was cut off.
    """
    folder.mkdir(parents=True)
    model.write_text(folder)
    line_counts = {
        "rigs": model.num_rigs(),
        "frames": model.num_reg_frames(),
        "images": 2 * model.num_reg_images(),
        "points3D": model.num_points3D(),
        "cameras": model.num_cameras(),
    }
    for name, count in line_counts.items():
        with (folder / f"{name}.txt").open("rb") as file:
            os.fsync(file.fileno())
            lines = [line for line in file if not line.startswith(b"#")]
        if len(lines) != count or (lines and not lines[-1].endswith(b"\n")):
            raise OSError(f"{name}.txt was cut off after {len(lines)} of {count} lines")


def _check(name: str, image: Any | None, model: Any) -> CameraCheck:
    if image is None:
        advice = f"it could not be registered and has no pose: {_MORE_TEXTURE}"
        return CameraCheck(name, 0, float("nan"), None, advice)
    errors = []
    for point in image.get_observation_points2D():
        pixel = image.project_point(model.point3D(point.point3D_id).xyz)
        # No pixel: the point lies behind the camera.
        errors.append(np.inf if pixel is None else np.linalg.norm(pixel - point.xy))
    error = median(errors)
    advice = ""
    if len(errors) < _MIN_POINTS:
        advice = (
            f"only {len(errors)} points, {_MIN_POINTS} are needed for a reliable pose: "
            f"{_MORE_TEXTURE}"
        )
    elif error > MAX_ERROR:
        advice = "its points do not fit: try a camera model with more parameters (--camera-model)"
    return CameraCheck(name, len(errors), error, not advice, advice)


def _frames(path: Path, config: CalibrateConfig, without: Sequence[str]) -> tuple[Arrays, Arrays]:
    """Return one image per camera by its name, and the masks of opaque pixels of images with
    transparent ones.
    """
    clips = find_clips(path)
    names = names_without(path, clips, without)
    broken = [name for name in names if "\n" in name]
    require(
        not broken,
        path,
        "expected names without line feeds, as COLMAP has one image a line",
        repr(few(broken)),
        "rename it",
    )
    if len(names) < 2:
        raise ValueError(
            f"{path}: expected the clips of at least two cameras, found "
            f"{', '.join(names) or 'none'}; check the path, or make {EXAMPLE}"
        )
    white = read_settings(path / CAPTURE).white
    readers = open_clips({name: clips[name] for name in names}, white=white)
    # The last timestamp of each clip, in frames of a constant rate.
    last_frames = {
        name: reader.num_held - 1 if reader.positions is None else round(reader.positions[-1])
        for name, reader in readers.items()
    }
    if short := [name for name, last in last_frames.items() if not 0 <= config.frame <= last]:
        raise ValueError(
            f"{path}: frame {config.frame} is not in the clips of {', '.join(short)}; choose "
            "another one (--frame)."
        )
    frames = {}
    masks = {}
    for name, reader in readers.items():
        position = int(nearest_frames(reader, np.array([config.frame]))[0])
        frames[name] = next(reader.frames(position, position + 1))
        mask, *_ = opaque_pixels(reader, name)
        if mask is not None:
            masks[name] = mask
    stops = display_stops(frames.values())
    return {name: display_image(image, stops) for name, image in frames.items()}, masks


def match_views(
    path: Path,
    images: Arrays,
    masks: Arrays,
    scratch: Path,
    config: CalibrateConfig,
    report: Report,
) -> None:
    """Write images, features and matches of all pairs of views into a folder, for `map_views`.

    Args:
        path: the clips, for messages.
        images: image [H, W, 3] of each view, RGB uint8, by name.
        masks: bool [H, W], by name of a view: pixels in which features are looked for.
        scratch: the folder.
        config: settings of the features.
        report: called with (stage, done, total).

    Raises:
        ValueError: no two views match.
    """
    pycolmap = import_pycolmap()

    (scratch / _IMAGES).mkdir()
    names_by_size: dict[tuple[int, ...], list[str]] = {}
    for name, image in images.items():
        (scratch / _IMAGES / f"{name}.png").write_bytes(png_bytes(image))
        names_by_size.setdefault(image.shape[:2], []).append(f"{name}.png")
    reader = pycolmap.ImageReaderOptions(camera_model=config.camera_model)
    if masks:
        (scratch / _MASKS).mkdir()
        for name, image in images.items():  # COLMAP needs a mask for every image
            opaque = valid_pixels(masks.get(name), image.shape)
            image_of_mask = np.repeat(255 * opaque.astype(np.uint8)[..., None], 3, axis=2)
            (scratch / _MASKS / f"{name}.png.png").write_bytes(png_bytes(image_of_mask))
        reader.mask_path = scratch / _MASKS
    pycolmap.set_random_seed(config.seed)
    database = scratch / _DATABASE
    pycolmap.Database.open(database).close()
    inputs = database, scratch / _IMAGES
    mode = pycolmap.CameraMode.SINGLE if config.shared_intrinsics else pycolmap.CameraMode.PER_IMAGE
    for done, (size, names) in enumerate(names_by_size.items()):  # each makes a camera of its own
        report("Finding features", done, len(names_by_size))
        extraction = pycolmap.FeatureExtractionOptions(max_image_size=max(size))
        extraction.sift.peak_threshold = _PEAK
        # Else threads number them in any order.
        pycolmap.import_images(*inputs, mode, names, reader)
        pycolmap.extract_features(*inputs, names, mode, reader, extraction, pycolmap.Device.cpu)
    report("Finding features", len(names_by_size), len(names_by_size))
    with closing(pycolmap.Database.open(database)) as db:
        views = {Path(i.name).stem: i.image_id for i in db.read_all_images()}
        counts = {name: db.num_keypoints_for_image(view) for name, view in views.items()}
    poor = [f"{count} in {name}" for name, count in counts.items() if count < _MIN_FEATURES]
    require(
        not poor,
        path,
        f"expected at least {_MIN_FEATURES} features in every view",
        f"{', '.join(poor)}: too dark, blurred or uniform",
        f"{_MORE_TEXTURE}, or calibrate on another frame (--frame)",
    )
    report("Matching views", 0, 1)
    # Without a seed of its own, the verification keeps other matches on each run, and may lose a
    # view with few of them.
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    # Guided matching takes several times as long, and its poses are no better by matches of other
    # features.
    pycolmap.match_exhaustive(
        database, verification_options=verification, device=pycolmap.Device.cpu
    )
    report("Matching views", 1, 1)
    with closing(pycolmap.Database.open(database)) as db:
        _, geometries = db.read_two_view_geometries()
    if not any(len(geometry.inlier_matches) for geometry in geometries):
        raise ValueError(
            f"{path}: no two of the {len(counts)} views match: they may show different objects, "
            "be too far apart (more than about 30 degrees), or not be simultaneous; move the "
            f"cameras closer, or {_MORE_TEXTURE}."
        )


def map_views(path: Path, names: Sequence[str], scratch: Path, seed: int) -> Candidate:
    """Return the best model of incremental and of global mapping of the matches in a folder.

    If none is complete, both map the matches that agree with focal lengths found from pairs of
    views, too.

    Args:
        path: the clips, for messages.
        names: of the views.
        scratch: the folder that `match_views` has written.
        seed: of COLMAP.

    Raises:
        ValueError: no model was found.
    """
    pycolmap = import_pycolmap()

    candidates = _mapped(names, scratch, seed)
    if all(without_pose(candidate.checks) for candidate in candidates):
        pycolmap.calibrate_view_graph(
            scratch / _DATABASE, pycolmap.ViewGraphCalibrationOptions(random_seed=seed)
        )
        candidates += _mapped(names, scratch, seed)
    if not candidates:
        raise ValueError(
            f"{path}: the views match, but neither incremental nor global mapping by COLMAP found "
            "poses: their baselines may be too short or too wide, or all shared points may lie "
            "in one plane; try shared intrinsics (--shared-intrinsics), another frame (--frame), "
            f"or {_MORE_TEXTURE}."
        )
    return _with_principal_points(max(candidates, key=lambda candidate: candidate.rank), names)


def _mapped(names: Sequence[str], scratch: Path, seed: int) -> list[Candidate]:
    """Return the models of both mappers.

    Threads of a mapper share its random samples, which makes other models on some runs; one thread
    takes as long.
    """
    pycolmap = import_pycolmap()

    inputs = scratch / _DATABASE, scratch / _IMAGES, scratch
    settings = {"random_seed": seed, "num_threads": 1}
    incremental = pycolmap.IncrementalPipelineOptions(min_model_size=2, **settings)
    models_by_mapper: dict[Mapper, dict[int, Any]] = {
        "incremental": pycolmap.incremental_mapping(*inputs, incremental),
        "global": pycolmap.global_mapping(*inputs, pycolmap.GlobalPipelineOptions(**settings)),
    }
    return [
        Candidate(mapper, model, _checks(model, names))
        for mapper, models in models_by_mapper.items()
        for model in models.values()
    ]


def _with_principal_points(candidate: Candidate, names: Sequence[str]) -> Candidate:
    """Return the model with a camera and a principal point for each image, or as it is if that fits
    no better.
    """
    pycolmap = import_pycolmap()

    model = pycolmap.Reconstruction()  # a copy in which no two images share a camera
    config = pycolmap.BundleAdjustmentConfig()
    for image in _registered(candidate.model):
        i = image.image_id
        camera = pycolmap.Camera(candidate.model.camera(image.camera_id).todict())
        camera.camera_id = i
        model.add_camera_with_trivial_rig(camera)
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        image_copy = pycolmap.Image(image_id=i, camera_id=i, name=image.name, keypoints=keypoints)
        model.add_image_with_trivial_frame(image_copy, image.cam_from_world())
        config.add_image(i)
    for point in candidate.model.points3D.values():
        model.add_point3D(point.xyz, point.track, point.color)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False,
        refine_extra_params=False,
        refine_principal_point=True,
        print_summary=False,
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    if not _median_error(model) < (1 - _LEAST_DECREASE) * _median_error(candidate.model):
        return candidate
    return Candidate(candidate.mapper, model, _checks(model, names), principal_points=True)


def _median_error(model: Any) -> float:
    """Return the median of the reprojection errors of a model's points, px; NaN without points."""
    model.update_point_3d_errors()
    return median([point.error for point in model.points3D.values()])


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence COLMAP's log on standard error; this module reports failures itself."""
    pycolmap = import_pycolmap()

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level

"""From clips alone to a COLMAP model: features, matches and mapping of one frame by pycolmap.

The model's world has no scale and no up: COLMAP can know neither.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from morgs_mi.capture.layouts.clips import clips_by_camera
from morgs_mi.core.files import atomic_path
from morgs_mi.io.video import open_frames

__all__ = ["CalibrateConfig", "Calibrated", "calibrate"]

# Fewer features, or fewer matches that agree in a pair, leave COLMAP nothing to hold on to.
_MIN_FEATURES = 100
_TRIES = 3
_MORE_TEXTURE = "light the scene evenly, put something with texture into it, or record a frame with it before the take"


@dataclass(frozen=True)
class CalibrateConfig:
    """How the cameras are found."""

    camera_model: Literal[
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"
    ] = "SIMPLE_RADIAL"
    """COLMAP's; one with more parameters needs more views, or shared intrinsics."""
    shared_intrinsics: bool = False
    """All cameras are of one make and zoom: one set of intrinsics, which few views determine better."""
    frame: int = 0
    """The instant to calibrate on."""
    partial: bool = False
    """Keep a model of only a part of the cameras."""
    seed: int = 0
    """Of COLMAP's random samples."""


@dataclass(frozen=True)
class Calibrated:
    """What `calibrate` has found.

    Attributes:
        model: folder of the COLMAP model.
        cameras: names of the calibrated cameras.
        left_out: names of the others.
        points: number of points.
        error: mean reprojection error of the points, px.
    """

    model: Path
    cameras: tuple[str, ...]
    left_out: tuple[str, ...]
    points: int
    error: float


def calibrate(
    path: str | Path,
    config: CalibrateConfig | None = None,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Calibrated:
    """Calibrate a folder of clips, one per camera, and write ``sparse/0`` there; nothing is written on failure.

    Args:
        path: the folder: videos, or a folder of images per camera.
        config: how.
        overwrite: replace a model that is there.
        progress: is called with (stage, done, total).

    Raises:
        FileNotFoundError: there is no such folder.
        FileExistsError: there is a `sparse` folder and `overwrite` is not given.
        ValueError: fewer than two clips, clips that cannot be read, or views that do not determine the cameras, in a
            sentence that says which and what to try.
        OSError: the model cannot be written.
    """
    path, config = Path(path), config or CalibrateConfig()
    tell = progress or (lambda stage, done, total: None)
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected a folder of clips, found none; check the path.")
    if (path / "sparse").exists() and not overwrite:
        raise FileExistsError(f"{path / 'sparse'}: expected none, got one; remove it, or overwrite it (--overwrite).")
    tell("Reading frames", 0, 1)
    images = _frames(path, config)
    tell("Reading frames", 1, 1)
    with tempfile.TemporaryDirectory() as scratch, _quiet():
        model = _map(path, images, Path(scratch), config, tell)
        found = {Path(model.image(i).name).stem for i in model.reg_image_ids()}
        names = tuple(name for name in images if name in found)
        left_out = tuple(name for name in images if name not in found)
        if left_out and not config.partial:
            raise ValueError(
                f"{path}: {len(names)} of {len(images)} cameras were found, {', '.join(left_out)} could not be tied to "
                f"them: move them so that neighbours see the same things, {_MORE_TEXTURE}, calibrate on another frame "
                "(--frame), or keep what was found (--partial)."
            )
        with atomic_path(path / "sparse", "calibrate()") as folder:
            (folder / "0").mkdir(parents=True)
            model.write_text(str(folder / "0"))
    error = float(model.compute_mean_reprojection_error())
    return Calibrated(path / "sparse" / "0", names, left_out, model.num_points3D(), error)


def _frames(path: Path, config: CalibrateConfig) -> dict[str, np.ndarray]:
    """Return one image of each camera by its name."""
    clips = clips_by_camera(path)
    if len(clips) < 2:
        found = ", ".join(clips) or "none"
        raise ValueError(f"{path}: expected the clips of at least two cameras, found {found}; check the path.")
    readers = {name: open_frames(clip) for name, clip in clips.items()}
    short = [name for name, reader in readers.items() if not 0 <= config.frame < reader.num_held]
    if short:
        raise ValueError(f"{path}: frame {config.frame} is not in the clips of {', '.join(short)}; choose another.")
    images = {name: next(reader.frames(config.frame, config.frame + 1)) for name, reader in readers.items()}
    sizes = {image.shape[1::-1] for image in images.values()}
    if config.shared_intrinsics and len(sizes) > 1:
        raise ValueError(
            f"{path}: shared intrinsics need clips of one size, got {', '.join(f'{w}x{h}' for w, h in sorted(sizes))}; "
            "give each camera its own."
        )
    return images


def _map(
    path: Path,
    images: dict[str, np.ndarray],
    scratch: Path,
    config: CalibrateConfig,
    tell: Callable[[str, int, int], None],
) -> Any:
    """Return pycolmap's reconstruction with the most cameras."""
    import pycolmap

    folder, database = scratch / "images", scratch / "database.db"
    folder.mkdir()
    for name, image in images.items():
        data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        (folder / f"{name}.png").write_bytes(data)
    pycolmap.set_random_seed(config.seed)
    tell("Finding features", 0, 1)
    mode = pycolmap.CameraMode.SINGLE if config.shared_intrinsics else pycolmap.CameraMode.PER_IMAGE
    reader = pycolmap.ImageReaderOptions(camera_model=config.camera_model)
    pycolmap.extract_features(database, folder, camera_mode=mode, reader_options=reader, device=pycolmap.Device.cpu)
    tell("Finding features", 1, 1)
    _check_features(path, database)
    tell("Matching views", 0, 1)
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    tell("Matching views", 1, 1)
    _check_pairs(path, database)
    tell("Mapping", 0, 1)
    models: list[Any] = []
    # Which views it begins with, and who is tied in, is partly chance: another draw may find who was missed.
    for attempt in range(_TRIES):
        options = pycolmap.IncrementalPipelineOptions(min_model_size=2, random_seed=config.seed + attempt)
        models += pycolmap.incremental_mapping(database, folder, scratch, options).values()
        if any(model.num_reg_images() == len(images) for model in models):
            break
    tell("Mapping", 1, 1)
    if not models:
        raise ValueError(
            f"{path}: the views match, but no two of them give COLMAP a start: their baselines may be too short or too "
            f"wide, or all that they share lies in one plane; try shared intrinsics (--shared-intrinsics), another "
            f"frame (--frame), or {_MORE_TEXTURE}."
        )
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))


def _check_features(path: Path, database: Path) -> None:
    with _opened(database) as db:
        counts = {Path(i.name).stem: db.num_keypoints_for_image(i.image_id) for i in db.read_all_images()}
    if poor := {name: count for name, count in counts.items() if count < _MIN_FEATURES}:
        table = ", ".join(f"{count} in {name}" for name, count in poor.items())
        raise ValueError(
            f"{path}: expected at least {_MIN_FEATURES} features in every view, got {table}: too dark, blurred or "
            f"bare; {_MORE_TEXTURE}, or calibrate on another frame (--frame)."
        )


def _check_pairs(path: Path, database: Path) -> None:
    with _opened(database) as db:
        names = {i.image_id: Path(i.name).stem for i in db.read_all_images()}
        pairs, geometries = db.read_two_view_geometries()
    tied = {i for pair, g in zip(pairs, geometries, strict=True) if len(g.inlier_matches) for i in _ids(pair)}
    if not tied:
        raise ValueError(
            f"{path}: no two of the {len(names)} views match: they may look at different things, from too far apart "
            f"(more than about 30 degrees), or not be of one instant; move the cameras closer, or {_MORE_TEXTURE}."
        )


def _ids(pair: Any) -> Sequence[int]:
    import pycolmap

    return pair if isinstance(pair, tuple) else pycolmap.pair_id_to_image_pair(pair)


@contextmanager
def _opened(database: Path) -> Iterator[Any]:
    import pycolmap

    db = pycolmap.Database.open(database)
    try:
        yield db
    finally:
        db.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP from logging to standard error: what matters is said in our own sentences."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before

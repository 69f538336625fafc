"""Synthetic captures: a scene path-traced from a rig of cameras, with exact ground truth.

Light is linear inside the path tracer and sRGB-encoded once, for the video. The ground truth is
sampled at pixel centres, so it has no noise and does not mix foreground and background.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

import mitsuba as mi
import numpy as np

from morgs_mi.capture.layouts.calibration import CalibratedImage
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.lens import undistortion
from morgs_mi.capture.outputs import check_output
from morgs_mi.capture.truth import Tracks, save_tracks, save_truth
from morgs_mi.core.camera import Camera
from morgs_mi.extras.synth.disturbances import (
    CameraDisturbance,
    draw_disturbances,
    save_disturbances,
)
from morgs_mi.extras.synth.ground_truth import (
    compute_ground_truth,
    move_with_objects,
)
from morgs_mi.extras.synth.path_tracer import PathTracer, developed
from morgs_mi.extras.synth.scene import Scene, check_scene, load_scene
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.io.clip_readers import open_frames
from morgs_mi.io.listing import is_added
from morgs_mi.io.video_writer import H264, write_video
from morgs_mi.platform.bounded import JsonObject, read_json
from morgs_mi.platform.checks import require
from morgs_mi.platform.config import check_ranges, config_or_default
from morgs_mi.platform.files import CAPTURE, atomic_path, write_json
from morgs_mi.platform.memory import check_memory
from morgs_mi.platform.progress import StepReport

_LOG = logging.getLogger(__name__)
# Bytes of a pixel of an image with its ground truth.
_PIXEL_BYTES = 100
_NUM_SFM_POINTS = 8000
_NUM_TRACKS = 2000
# Rows that a rolling shutter reads at one time; at 10 pixels per frame, objects move by 0.2 pixels
# in this time.
_BAND = 4


def synthesize(
    scene: str | Path | Scene,
    out: str | Path,
    config: SynthConfig | None = None,
    *,
    overwrite: bool = False,
    progress: StepReport | None = None,
) -> Path:
    """Path-trace a moving scene into a multi-view capture with exact ground truth.

    Writes ``frames/cam00/0000.png`` ..., ``cam00.mp4`` ... for players, a COLMAP text model
    ``sparse/0`` with points as from structure from motion, ``capture.json`` and ``truth/`` (see
    `ground_truth` and `disturbances`). ``cam00`` is the central camera of the rig and the held-out
    test view, as in N3DV. The folder is written atomically.

    Tracks are at the times of the frames of ``cam00``, the other ground truth at the times of each
    camera.

    Args:
        scene: a scene, its name, or the path of its Python file.
        out: the folder to write.
        config: settings.
        overwrite: replace an earlier capture in `out`.
        progress: called with (images done, total number of images).

    Returns:
        The folder `out`.

    Raises:
        ValueError: a setting is out of range, there is no such scene, `out` lies in a capture, the
            scene is not as `check_scene` requires, a camera sees none of its objects, or Mitsuba's
            variant is not vectorised.
        FileExistsError: `out` is not empty and `overwrite` is not set, or `out` is not a synthetic
            capture.
        OSError: a file cannot be written, or a mesh or texture of the scene does not exist.
    """
    require(
        str(mi.variant()).startswith(("llvm", "cuda", "metal")),
        "synthesize()",
        "a vectorised variant is needed",
        repr(mi.variant()),
        'call mitsuba.set_variant("llvm_ad_rgb") first',
    )
    config = config_or_default("synthesize()", config, SynthConfig())
    check_ranges(config, "synthesize()")
    check_memory(
        "synthesize()",
        _PIXEL_BYTES * config.width * config.height,
        f"images of {config.width}x{config.height} pixels",
        "make them smaller (`width`, `height`)",
    )
    scene = scene if isinstance(scene, Scene) else load_scene(scene, config.seed)
    completed = config.completed(scene.recording)
    assert completed.cameras is not None
    views = scene.rig.cameras(completed.cameras, config.width, config.height)
    disturbances = draw_disturbances(config.disturbances, len(views), config.seed)
    rig = _Rig(list(map(_RecordingCamera, views, disturbances)), completed)
    for camera in rig.cameras:
        camera.check_distortion()
    check_scene(scene, rig.times())
    out = Path(out)
    is_empty = out.is_dir() and all(is_added(file.name) for file in out.iterdir())
    # Recordings and fits have a `capture.json` too.
    is_synthetic = {"scene", "spp"} <= set(stored_settings(out))
    if out.exists() and not is_empty and not (overwrite and is_synthetic):
        reason = "is not a synthetic capture" if overwrite else "is not empty"
        raise FileExistsError(f"synthesize(): {out} {reason}; choose another folder.")
    check_output(out.resolve().parent)
    with atomic_path(out, "synthesize()") as folder:
        folder.mkdir(parents=True)
        tracer = PathTracer(scene)
        _check_views(tracer, rig.views)
        clips = _write_clips(tracer, rig, folder, progress)
        _write_truth(tracer, rig, folder / "truth")
        _write_calibration(tracer, rig, clips, folder)
        settings = {
            "scene": scene.name,
            "test_view": 0,
            **rig.config.as_dict(),
            "objects": list(scene.objects),
            "versions": {name: metadata.version(name) for name in ("morgs-mi", "mitsuba", "drjit")},
        }
        write_json(folder / CAPTURE, settings)
    return out


@dataclass(frozen=True)
class _RecordingCamera:
    """A camera that records a scene."""

    view: Camera  # without distortion
    disturbance: CameraDisturbance

    def check_distortion(self) -> None:
        """Raise `ValueError` if the lens folds the corners of the view."""
        k = self.disturbance.distortion
        if k < 0:
            corner = np.linalg.norm(self.view.K[:2, 2] / np.diag(self.view.K)[:2])
            # r (1 + k r^2) grows up to r = 1 / sqrt(-3 k).
            largest = 2 / (3 * np.sqrt(-3 * k))
            require(
                corner < 0.98 * largest,
                "synthesize()",
                "`distortion` must be small enough for the field of view",
                f"{k:.3g} with corners at the radius {corner:.3g}, which must be below "
                f"{largest:.3g}",
                "set a smaller one",
            )

    def light(self, tracer: PathTracer, frame: int, config: SynthConfig) -> np.ndarray:
        """Return the light of a frame that the camera with its clock, shutter and lens receives,
        linear [H, W, 3].

        Args:
            tracer: the scene; its time is changed.
            frame: index of the frame.
            config: samples per pixel, their seed and the frame rate.
        """
        assert config.spp is not None
        disturbance = self.disturbance
        height = self.view.height
        if not disturbance.rolling_shutter and not disturbance.distortion:
            tracer.set_time((frame + disturbance.time_offset) / config.fps)
            return tracer.light(self.view, config.spp, config.seed)
        row_times = disturbance.row_times(frame, height)
        count = -(-height // _BAND) if disturbance.rolling_shutter else 1
        bands = []
        for band, rows in enumerate(np.array_split(np.arange(height), count)):
            tracer.set_time(row_times[rows].mean() / config.fps)
            seed = _mixed_seed(config.seed, band)
            light = tracer.light_of_rows(self.view, rows, config.spp, seed, disturbance.lens)
            bands.append(light)
        return np.concatenate(bands)


@dataclass(frozen=True)
class _Rig:
    """Cameras that record a scene."""

    cameras: Sequence[_RecordingCamera]
    config: SynthConfig  # complete settings

    @property
    def views(self) -> list[Camera]:
        """The cameras without disturbances."""
        return [camera.view for camera in self.cameras]

    def times(self) -> list[float]:
        """Return the times of the frames, the time after the last one, and the extreme times of
        read rows, seconds.
        """
        ends = (0, 0), (self.config.frames, -1)
        times = [
            camera.disturbance.row_times(frame, self.config.height)[row]
            for camera in self.cameras
            for frame, row in ends
        ]
        return [
            float(t) / self.config.fps
            for t in sorted({*range(self.config.frames + 1), min(times), max(times)})
        ]


def _mixed_seed(*numbers: int) -> int:
    """Return a seed that depends on several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def _write_clips(
    tracer: PathTracer, rig: _Rig, folder: Path, progress: StepReport | None
) -> list[Path]:
    """Write the images of all cameras; return the clips that `load_capture` reads."""
    config = rig.config
    noise = config.noise
    assert noise is not None
    count = itertools.count(1)

    def images(index: int, camera: _RecordingCamera) -> Iterator[np.ndarray]:
        for frame in range(config.frames):
            # The noise must differ between views and frames; otherwise it would look like a moving
            # texture.
            seed = _mixed_seed(config.seed, index, frame)
            light = camera.light(tracer, frame, replace(config, seed=seed))
            yield developed(light, noise, seed)
            if progress is not None:
                progress(next(count), len(rig.cameras) * config.frames)

    clips = []
    for index, camera in enumerate(rig.cameras):
        name = camera.view.name
        video = folder / f"{name}.mp4"
        if config.lossless:
            png = folder / "frames" / name
            write_video(png, images(index, camera), config.fps)
            write_video(video, open_frames(png).frames(), config.fps, H264)
            clips.append(png)
        else:
            write_video(video, images(index, camera), config.fps, H264)
            clips.append(video)
    return clips


def _check_views(tracer: PathTracer, cameras: Sequence[Camera]) -> None:
    """Raise `ValueError` without light or if a camera sees no object in the first frame; warn of
    black images.
    """
    where = f"scene {tracer.scene.name!r}"
    require(
        tracer.has_emitters,
        where,
        "expected an emitter",
        "none, for black images",
        "give it lights, e.g. `lights()` of morgs_mi.extras.synth.textures",
    )
    for camera in cameras:
        require(
            (tracer.surface_points(camera).ids >= 0).any(),
            where,
            f"{camera.name} must see an object at 0 s",
            "none",
            "move the objects or the rig",
        )
    if not tracer.render(cameras[0], 1, 0).any():
        _LOG.warning(
            "scene %r: %s is black at 0 s: no lamp reaches the objects that it sees; check the "
            "sides to which lamps and surfaces face (a rectangle emits along its +z).",
            tracer.scene.name,
            cameras[0].name,
        )


def _write_truth(tracer: PathTracer, rig: _Rig, folder: Path) -> None:
    """Write the ground truth of every camera, the tracks and the disturbances."""
    fps = rig.config.fps
    frames = np.arange(rig.config.frames)
    for camera in rig.cameras:
        view = camera.view
        times = (frames + camera.disturbance.time_offset) / fps
        old_poses = None
        for frame, time in enumerate(times):
            tracer.set_time(time)
            poses = tracer.poses(time)
            surface = tracer.surface_points(view)
            next_poses = tracer.poses(time + 1 / fps)
            truth = compute_ground_truth(view, surface, poses, old_poses, next_poses)
            save_truth(folder, view.name, frame, truth)
            old_poses = poses
    rng = np.random.default_rng([rig.config.seed, 1])
    save_tracks(folder, _sample_tracks(tracer, rig.views, frames / fps, rng))
    save_disturbances(folder, {camera.view.name: camera.disturbance for camera in rig.cameras})


def _sample_tracks(
    tracer: PathTracer, cameras: Sequence[Camera], times: np.ndarray, rng: np.random.Generator
) -> Tracks:
    """Return the tracks of surface points that are visible in the first, middle or last frame.

    Half of the points lie on moving objects.
    """
    starts = sorted({0, len(times) // 2, len(times) - 1})
    share = -(-_NUM_TRACKS // (2 * len(starts) * len(cameras)))
    points = []
    owners = []
    can_move = np.array([item.pose is not None for item in tracer.scene.objects.values()])
    poses = [tracer.poses(time) for time in times]
    for start in starts:
        tracer.set_time(times[start])
        for camera in cameras:
            surface = tracer.surface_points(camera)
            for moving in (False, True):
                pixels = np.flatnonzero((surface.ids >= 0) & (can_move[surface.ids] == moving))
                sample = surface.pick(rng.choice(pixels, min(share, len(pixels)), replace=False))
                paths = [move_with_objects(sample, poses[start], pose) for pose in poses]
                points.append(np.stack(paths, axis=1))
                owners.append(sample.ids)
    tracks = np.concatenate(points)
    visible = {camera.name: np.zeros(tracks.shape[:2], bool) for camera in cameras}
    for frame, time in enumerate(times):
        tracer.set_time(time)
        for camera in cameras:
            visible[camera.name][:, frame] = tracer.sees(camera, tracks[:, frame])
    return Tracks(tracks, np.concatenate(owners), visible)


def _write_calibration(tracer: PathTracer, rig: _Rig, clips: Sequence[Path], folder: Path) -> None:
    """Write the cameras as a COLMAP model with points from the training views.

    The points have the colours of the `clips`, one per camera.
    """
    rng = np.random.default_rng([rig.config.seed, 2])
    points = []
    colors = []
    for index, camera in enumerate(rig.cameras):
        view = camera.view
        tracer.set_time(camera.disturbance.time_offset / rig.config.fps)
        lens = undistortion(view, camera.disturbance.lens)
        surface = tracer.surface_points(view)
        # The pixels with a surface that the lens shows.
        pixels = np.flatnonzero((surface.ids >= 0) & (lens is None or lens.mask))
        positions = surface.pick(pixels).positions
        _, depths = view.project(positions)
        if index == 0:
            continue  # the held-out view must not contribute points or colours
        most = _NUM_SFM_POINTS // (len(rig.cameras) - 1)
        choice = rng.choice(len(pixels), min(most, len(pixels)), replace=False)
        # Structure from motion has an error of about half a pixel; here it is the same along the
        # ray.
        pixel_width = depths[choice, None] / view.K[0, 0]
        points.append(positions[choice] + rng.normal(size=(len(choice), 3)) * (0.5 * pixel_width))
        image = next(open_frames(clips[index]).frames(0, 1))
        image = image if lens is None else lens(image)
        colors.append(image.reshape(-1, 3)[pixels[choice]] / 255)
    images = [CalibratedImage(camera.view, camera.disturbance.lens) for camera in rig.cameras]
    model = folder / "sparse" / "0"
    write_colmap(model, images, np.concatenate(points), np.concatenate(colors))


def stored_settings(folder: Path) -> JsonObject:
    """Return the content of a folder's `capture.json`; empty if there is none, or a broken one."""
    try:
        settings = read_json(folder / CAPTURE)
    except (OSError, ValueError):
        return {}
    return settings if isinstance(settings, dict) else {}

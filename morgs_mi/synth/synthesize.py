"""Synthetic captures: a scene path-traced from a rig of cameras, with exact ground truth.

Light is linear inside the path tracer and sRGB-encoded once, for the video. The ground truth is sampled at pixel
centres, so it has no noise and does not mix foreground and background.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

import mitsuba as mi
import numpy as np

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.layouts.poses_bounds import write_poses_bounds
from morgs_mi.capture.lens import undistortion
from morgs_mi.capture.outputs import check_output
from morgs_mi.core.camera import Camera
from morgs_mi.core.files import atomic_path, write_json
from morgs_mi.io.bounded import read_json
from morgs_mi.io.video import open_frames
from morgs_mi.io.video_writer import playable_format, write_video
from morgs_mi.synth.disturbances import (
    CameraDisturbance,
    Disturbances,
    compressed,
    draw_disturbances,
    save_disturbances,
)
from morgs_mi.synth.gltf_scene import gltf_scene
from morgs_mi.synth.ground_truth import Tracks, compute_ground_truth, move_with_objects, save_tracks, save_truth
from morgs_mi.synth.path_tracer import PathTracer, developed
from morgs_mi.synth.recording import check_lenses, record_light
from morgs_mi.synth.scene import DeformingObject, Scene, check_scene, load_scene

__all__ = ["synthesize"]

_LOG = logging.getLogger(__name__)
_NUM_SFM_POINTS = 8000
_NUM_TRACKS = 2000


def synthesize(
    scene: str | Path | Scene,
    out: str | Path,
    *,
    num_cameras: int | None = None,
    num_frames: int = 12,
    width: int = 320,
    height: int = 240,
    spp: int | None = None,
    noise: float | None = None,
    fps: float = 30.0,
    lossless: bool = True,
    disturbances: Disturbances | None = None,
    animation: str | None = None,
    seed: int = 0,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Path-trace a moving scene into a multi-view capture in N3DV's layout, with exact ground truth.

    Writes ``frames/cam00/0000.png`` ..., ``cam00.mp4`` ... for players (see `playable_format`), ``poses_bounds.npy``, a
    COLMAP text model ``sparse/0`` with points like those of structure from motion, ``capture.json`` and ``truth/`` (see
    `ground_truth` and `disturbances`). ``cam00`` is the central camera of the rig and the held-out test view, as in
    N3DV. With lens distortion there is no ``poses_bounds.npy``, which cannot hold it. The folder is written atomically.

    Tracks are at the times of the frames of ``cam00``, the other ground truth at those of each camera.

    Args:
        scene: a scene, its name, or the path of its Python file or of an animated glTF file (see `gltf_scene`).
        out: the folder to write.
        num_cameras: including the test view, at least 2; None for the scene's own number, usually 10.
        num_frames: at least 1.
        width: in pixels, even.
        height: in pixels, even.
        spp: samples per pixel; the noise of 16 is at 42 dB, below that of a good camera. None for the scene's own
            number, usually 16.
        noise: standard deviation of the sensor noise, relative to white; 0.01 (2.5 grey levels) is typical of a camera
            indoors. None for the scene's own, usually 0.
        fps: frames per second.
        lossless: write the frames also as PNG files, which `load_capture` reads in place of the videos; without them
            the images and the colours of the points are those of the compressed videos.
        disturbances: clocks, shutters, exposure, lenses and compression that make the recording hard; None for none.
        animation: name of the animation of a glTF file; None for its first.
        seed: of the textures, the sampling noise, the disturbances and the choice of points.
        overwrite: replace an earlier capture in `out`.
        progress: called with (images done, total number of images).

    Returns:
        The folder `out`.

    Raises:
        ValueError: an argument is out of range, there is no such scene, `out` lies in a capture, the scene is not as
            `check_scene` requires, a camera sees none of its objects, or Mitsuba's variant is not vectorised.
        FileExistsError: `out` is not empty and `overwrite` is not set, or `out` is not a synthetic capture.
        OSError: a file cannot be written, or a mesh or texture of the scene does not exist.
    """
    if not str(mi.variant()).startswith(("llvm", "cuda", "metal")):
        raise ValueError(
            f"synthesize(): a vectorised variant is needed, got {mi.variant()!r}; "
            'call mitsuba.set_variant("llvm_ad_rgb") first.'
        )
    _check_arguments(num_cameras, num_frames, width, height, spp, noise, fps, seed)
    scene = _loaded(scene, animation, seed)
    num_cameras = scene.recording.num_cameras if num_cameras is None else num_cameras
    spp = scene.recording.spp if spp is None else spp
    noise = scene.recording.noise if noise is None else noise
    cameras = scene.rig.cameras(num_cameras, width, height)
    disturbances = disturbances or Disturbances()
    disturbed = draw_disturbances(disturbances, num_cameras, num_frames, seed)
    check_lenses(cameras, disturbed)
    frames = np.arange(num_frames + 1)
    # Each frame and the one after the last, and the first and the last row that any camera reads.
    read = [d.row_times(f, height)[row] for d in disturbed for f, row in ((0, 0), (num_frames, -1))]
    check_scene(scene, [float(frame) / fps for frame in sorted({*frames.tolist(), min(read), max(read)})])
    _check_folder(Path(out), overwrite)
    check_output(Path(out).resolve().parent)
    with atomic_path(out, "synthesize()") as folder:
        folder.mkdir(parents=True)
        tracer = PathTracer(scene)
        _check_views(tracer, cameras)
        done = 0

        def render_view(index: int) -> Iterator[np.ndarray]:
            nonlocal done
            for frame in range(num_frames):
                # The noise must differ between views and frames; otherwise it would look like a moving texture.
                noise_seed = int(np.random.SeedSequence([seed, index, frame]).generate_state(1)[0])
                light = record_light(tracer, cameras[index], disturbed[index], frame, fps, spp, noise_seed)
                image = developed(disturbed[index].gains[frame] * light, noise, noise_seed)
                yield compressed(image, disturbed[index].jpeg_quality)
                done += 1
                if progress is not None:
                    progress(done, num_cameras * num_frames)

        suffix, codec = playable_format()
        clips = []
        for index, (camera, own) in enumerate(zip(cameras, disturbed, strict=True)):
            video, png = folder / f"{camera.name}{suffix}", folder / "frames" / camera.name
            if lossless:
                write_video(png, render_view(index), fps)
            images = open_frames(png).frames() if lossless else render_view(index)
            write_video(video, images, fps, codec)
            clips.append(png if lossless else video)
            _write_truth(tracer, camera, (frames[:-1] + own.time_offset) / fps, fps, folder / "truth")
        times = frames[:-1] / fps
        save_tracks(folder / "truth", _sample_tracks(tracer, cameras, times, np.random.default_rng([seed, 1])))
        save_disturbances(folder / "truth", dict(zip((c.name for c in cameras), disturbed, strict=True)))
        _write_calibration(tracer, cameras, disturbed, fps, clips, folder, np.random.default_rng([seed, 2]))
        about = {
            "scene": scene.name,
            "test_view": 0,
            "fps": fps,
            "num_cameras": num_cameras,
            "num_frames": num_frames,
            "width": width,
            "height": height,
            "spp": spp,
            "noise": noise,
            "disturbances": asdict(disturbances),
            "animation": animation,
            "seed": seed,
            "objects": list(scene.objects),
            "versions": {name: metadata.version(name) for name in ("morgs-mi", "mitsuba", "drjit")},
        }
        write_json(folder / "capture.json", about)
    return Path(out)


def _check_arguments(
    num_cameras: int | None,
    num_frames: int,
    width: int,
    height: int,
    spp: int | None,
    noise: float | None,
    fps: float,
    seed: int,
) -> None:
    lowest = {
        "num_cameras": (num_cameras, 2),
        "num_frames": (num_frames, 1),
        "spp": (spp, 1),
        "seed": (seed, 0),
    }
    for name, (value, least) in lowest.items():
        if value is not None and value < least:
            raise ValueError(f"synthesize(): `{name}` must be at least {least}, got {value}.")
    if min(width, height) < 2 or width % 2 or height % 2:
        raise ValueError(f"synthesize(): `width` and `height` must be even, got {width}x{height}.")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"synthesize(): `fps` must be positive, got {fps}.")
    if noise is not None and not 0 <= noise < 1:
        raise ValueError(f"synthesize(): `noise` must be at least 0 and below 1, got {noise}.")


def _loaded(scene: str | Path | Scene, animation: str | None, seed: int) -> Scene:
    """Return a scene, or load that of a file or a name."""
    if not isinstance(scene, Scene) and Path(scene).suffix.lower() in (".glb", ".gltf"):
        return gltf_scene(scene, animation, seed)
    if animation is not None:
        raise ValueError("synthesize(): `animation` is for glTF files, got another scene; leave it out.")
    return scene if isinstance(scene, Scene) else load_scene(scene, seed)


def _check_views(tracer: PathTracer, cameras: Sequence[Camera]) -> None:
    """Raise `ValueError` without light or if a camera sees no object in the first frame; warn of black images."""
    if not tracer.has_emitters:
        raise ValueError(
            f"scene {tracer.scene.name!r}: it has no emitter, so its images would be black; give it lights, e.g. "
            "`lights()` of morgs_mi.synth.textures."
        )
    for camera in cameras:
        if not (tracer.surface_points(camera).ids >= 0).any():
            raise ValueError(
                f"scene {tracer.scene.name!r}: {camera.name} sees no object at 0 s; move the objects, or "
                "the centre and distance of the rig."
            )
    if not tracer.render(cameras[0], 1, 0).any():
        _LOG.warning(
            "scene %r: %s is black at 0 s: no lamp reaches the objects that it sees; check the sides to which lamps "
            "and surfaces face (a rectangle emits along its +z).",
            tracer.scene.name,
            cameras[0].name,
        )


def _write_truth(tracer: PathTracer, camera: Camera, times: np.ndarray, fps: float, folder: Path) -> None:
    for frame, time in enumerate(times):
        tracer.set_time(time)
        surface, before = tracer.surface_points(camera), tracer.poses(times[frame - 1]) if frame else None
        truth = compute_ground_truth(camera, surface, tracer.poses(time), before, tracer.poses(time + 1 / fps))
        save_truth(folder, camera.name, frame, truth)


def _sample_tracks(
    tracer: PathTracer, cameras: Sequence[Camera], times: np.ndarray, rng: np.random.Generator
) -> Tracks:
    """Return the tracks of surface points that are visible in the first, middle or last frame.

    Half of the points lie on moving objects.
    """
    starts = sorted({0, len(times) // 2, len(times) - 1})
    objects = tracer.scene.objects.values()
    can_move = np.array([isinstance(item, DeformingObject) or item.pose is not None for item in objects])
    share = -(-_NUM_TRACKS // (2 * len(starts) * len(cameras)))
    points, owners, poses = [], [], [tracer.poses(time) for time in times]
    for start in starts:
        tracer.set_time(times[start])
        for camera in cameras:
            visible = tracer.surface_points(camera)
            for moving in (False, True):
                pixels = np.flatnonzero((visible.ids >= 0) & (can_move[visible.ids] == moving))
                pixels = rng.choice(pixels, min(share, len(pixels)), replace=False)
                own = visible.pick(pixels)
                points.append(np.stack([move_with_objects(own, poses[start], there) for there in poses], axis=1))
                owners.append(own.ids)
    tracks = np.concatenate(points)
    visible = {camera.name: np.zeros(tracks.shape[:2], bool) for camera in cameras}
    for frame, time in enumerate(times):
        tracer.set_time(time)
        for camera in cameras:
            visible[camera.name][:, frame] = tracer.sees(camera, tracks[:, frame])
    return Tracks(tracks, np.concatenate(owners), visible)


def _write_calibration(
    tracer: PathTracer,
    cameras: Sequence[Camera],
    disturbed: Sequence[CameraDisturbance],
    fps: float,
    clips: Sequence[Path],
    folder: Path,
    rng: np.random.Generator,
) -> None:
    """Write the cameras as `poses_bounds.npy` and as a COLMAP model with points from the training views.

    The colours of the points are those of the `clips`, one per camera.
    """
    points, colors, bounds = [], [], []
    for index, (camera, own) in enumerate(zip(cameras, disturbed, strict=True)):
        tracer.set_time(own.time_offset / fps)
        visible, lens = tracer.surface_points(camera), undistortion(camera, own.lens)
        pixels = np.flatnonzero((visible.ids >= 0) & (lens is None or lens.mask))
        depths = camera.project(visible.pick(pixels).positions)[1]
        # LLFF's percentiles, which readers of the file expect.
        bounds.append(np.percentile(depths, [0.1, 99.9]))
        if index == 0:
            continue  # the held-out view must not contribute points or colours
        chosen = rng.choice(len(pixels), min(_NUM_SFM_POINTS // (len(cameras) - 1), len(pixels)), replace=False)
        # Structure from motion has an error of about half a pixel; here it is the same along the ray.
        noise = rng.normal(size=(len(chosen), 3)) * (0.5 * depths[chosen, None] / camera.K[0, 0])
        points.append(visible.pick(pixels[chosen]).positions + noise)
        image = next(open_frames(clips[index]).frames(0, 1))
        image = image if lens is None else lens(image)
        colors.append(image.reshape(-1, 3)[pixels[chosen]] / 255)
    if not any(own.distortion for own in disturbed):
        write_poses_bounds(folder / "poses_bounds.npy", cameras, np.array(bounds))
    lenses = [own.lens for own in disturbed]
    write_colmap(folder / "sparse" / "0", cameras, np.concatenate(points), np.concatenate(colors), lenses)


def _check_folder(out: Path, overwrite: bool) -> None:
    """Raise `FileExistsError` if `out` must not be replaced."""
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"synthesize(): {out} is a file; choose another folder.")
    occupied = out.is_dir() and any(out.iterdir())
    if occupied and not overwrite:
        raise FileExistsError(f"synthesize(): {out} is not empty; choose another folder, or set `overwrite`.")
    if occupied and not _is_synthetic(out):
        raise FileExistsError(
            f"synthesize(): {out} is not a synthetic capture, so it is not replaced; choose another folder."
        )


def _is_synthetic(folder: Path) -> bool:
    """Return whether a folder is a capture written by `synthesize`: recordings and fits have a `capture.json` too."""
    try:
        about = read_json(folder / "capture.json")
    except (OSError, ValueError):
        return False
    return isinstance(about, dict) and {"scene", "spp"} <= set(about)

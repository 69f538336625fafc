"""Synthetic captures: a scene path-traced from a rig of cameras, with exact ground truth.

Light is linear inside the path tracer and sRGB-encoded once, on its way into the video. Surfaces are asked
at pixel centres, so that the truth has no noise and no blend of foreground and background.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path

import mitsuba as mi
import numpy as np

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.layouts.poses_bounds import write_poses_bounds
from morgs_mi.core.camera import Camera
from morgs_mi.core.files import atomic_path, write_json
from morgs_mi.io.video import VideoReader
from morgs_mi.io.video_writer import write_video
from morgs_mi.synth.ground_truth import Tracks, carry, ground_truth_of, project, save_truth
from morgs_mi.synth.path_tracer import PathTracer
from morgs_mi.synth.scene import Scene, load_scene

__all__ = ["synthesize"]

_NUM_SFM_POINTS = 8000
_NUM_TRACKS = 2000


def synthesize(
    scene: str | Path | Scene,
    out: str | Path,
    *,
    num_cameras: int = 10,
    num_frames: int = 12,
    width: int = 320,
    height: int = 240,
    spp: int = 16,
    noise: float = 0.0,
    fps: float = 30.0,
    lossless: bool = False,
    seed: int = 0,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Path-trace a moving scene into a multi-view capture in N3DV's layout, with exact ground truth.

    Writes ``cam00.mp4`` ..., ``poses_bounds.npy``, a COLMAP text model ``sparse/0`` with points as structure
    from motion would find them, ``capture.json`` and ``truth/`` (see `truth`). ``cam00`` stands in the middle
    of the rig and is the held-out test view, as in N3DV. The folder appears whole or not at all.

    Args:
        scene: a scene, its name, or the path of its Python file.
        out: the folder to make.
        num_cameras: the test view included, at least 2.
        num_frames: at least 1.
        width: in pixels, even.
        height: in pixels, even.
        spp: samples per pixel; 16 leaves noise at 42 dB, below that of a good camera.
        noise: standard deviation of the sensor's noise, of white; 0.01, 2.5 grey levels, is that of a camera indoors.
        fps: frames per second.
        lossless: also write ``frames/cam00/0000.png`` ....
        seed: of textures, sampling noise and the choice of points.
        overwrite: replace an earlier capture in `out`.
        progress: called with (pictures done, pictures in all).

    Returns:
        The folder `out`.

    Raises:
        ValueError: if an argument is out of range, there is no such scene, or Mitsuba's variant is not a
            vectorised one.
        FileExistsError: if `out` is not empty and `overwrite` is not set, or `out` holds something else
            than a capture.
        OSError: if something cannot be written.
    """
    if not str(mi.variant()).startswith(("llvm", "cuda")):
        raise ValueError(
            f"synthesize(): a vectorised variant is needed, got {mi.variant()!r}; "
            'call mitsuba.set_variant("llvm_ad_rgb") first.'
        )
    lowest = {
        "num_cameras": (num_cameras, 2),
        "num_frames": (num_frames, 1),
        "spp": (spp, 1),
        "seed": (seed, 0),
    }
    for name, (value, least) in lowest.items():
        if value < least:
            raise ValueError(f"synthesize(): `{name}` must be at least {least}, got {value}.")
    if min(width, height) < 2 or width % 2 or height % 2:
        raise ValueError(f"synthesize(): `width` and `height` must be even, got {width}x{height}.")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"synthesize(): `fps` must be positive, got {fps}.")
    if not 0 <= noise < 1:
        raise ValueError(f"synthesize(): `noise` must be at least 0 and below 1, got {noise}.")

    scene = scene if isinstance(scene, Scene) else load_scene(scene, seed)
    cameras = scene.rig.cameras(num_cameras, width, height)
    times = np.arange(num_frames) / fps
    _check_folder(Path(out), overwrite)
    with atomic_path(out, "synthesize()") as folder:
        folder.mkdir(parents=True)
        stage = PathTracer(scene)
        done = 0

        def film(index: int) -> Iterator[np.ndarray]:
            nonlocal done
            for frame, time in enumerate(times):
                stage.move(time)
                # Noise must differ between views and frames, or it would look like texture that moves along.
                grain = int(np.random.SeedSequence([seed, index, frame]).generate_state(1)[0])
                yield stage.picture(cameras[index], spp, grain, noise)
                done += 1
                if progress is not None:
                    progress(done, num_cameras * num_frames)

        for index, camera in enumerate(cameras):
            video = folder / f"{camera.name}.mp4"
            write_video(video, film(index), fps)
            if lossless:
                write_video(folder / "frames" / camera.name, VideoReader.open(video).frames(), fps)
            _write_truth(stage, camera, times, fps, folder / "truth")
        tracks = _tracks(stage, cameras, times, np.random.default_rng([seed, 1]))
        np.savez_compressed(folder / "truth" / "tracks.npz", points=tracks.points, ids=tracks.ids)
        _write_calibration(stage, cameras, folder, np.random.default_rng([seed, 2]))
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
            "seed": seed,
            "objects": list(scene.objects),
            "versions": {name: metadata.version(name) for name in ("morgs-mi", "mitsuba", "drjit")},
        }
        write_json(folder / "capture.json", about)
    return Path(out)


def _write_truth(stage: PathTracer, camera: Camera, times: np.ndarray, fps: float, folder: Path) -> None:
    for frame, time in enumerate(times):
        stage.move(time)
        points, ids = stage.surface(camera)
        before = stage.poses(times[frame - 1]) if frame else None
        truth = ground_truth_of(camera, points, ids, stage.poses(time), before, stage.poses(time + 1 / fps))
        save_truth(folder, camera.name, frame, truth)


def _tracks(stage: PathTracer, cameras: Sequence[Camera], times: np.ndarray, rng: np.random.Generator) -> Tracks:
    """Follow surface points seen by any camera in the first, middle or last frame; half of them can move."""
    starts = sorted({0, len(times) // 2, len(times) - 1})
    can_move = np.array([thing.pose is not None for thing in stage.scene.objects.values()])
    share = -(-_NUM_TRACKS // (2 * len(starts) * len(cameras)))
    points, owners = [], []
    for start in starts:
        stage.move(times[start])
        poses = stage.poses(times[start])
        for camera in cameras:
            seen, ids = stage.surface(camera)
            for moving in (False, True):
                pixels = np.flatnonzero((ids >= 0) & (can_move[ids] == moving))
                pixels = rng.choice(pixels, min(share, len(pixels)), replace=False)
                here, own = seen.reshape(-1, 3)[pixels], ids.ravel()[pixels]
                points.append(np.stack([carry(here, own, poses, stage.poses(t)) for t in times], axis=1))
                owners.append(own)
    return Tracks(np.concatenate(points), np.concatenate(owners))


def _write_calibration(stage: PathTracer, cameras: Sequence[Camera], folder: Path, rng: np.random.Generator) -> None:
    """Write the cameras as `poses_bounds.npy` and as a COLMAP model with points from the training views."""
    stage.move(0.0)
    points, colors, bounds = [], [], []
    for index, camera in enumerate(cameras):
        seen, ids = stage.surface(camera)
        seen, pixels = seen.reshape(-1, 3), np.flatnonzero(ids >= 0)
        depths = project(camera, seen[pixels])[1]
        # LLFF's percentiles, so that readers of the file see the bounds they expect.
        bounds.append(np.percentile(depths, [0.1, 99.9]))
        if index == 0:
            continue  # the held-out view may not help to place or colour points
        chosen = rng.choice(len(pixels), min(_NUM_SFM_POINTS // (len(cameras) - 1), len(pixels)), replace=False)
        # Structure from motion leaves about half a pixel of error; here it is the same along the ray.
        noise = rng.normal(size=(len(chosen), 3)) * (0.5 * depths[chosen, None] / camera.K[0, 0])
        points.append(seen[pixels[chosen]] + noise)
        image = next(VideoReader.open(folder / f"{camera.name}.mp4").frames(0, 1))
        colors.append(image.reshape(-1, 3)[pixels[chosen]] / 255)
    write_poses_bounds(folder / "poses_bounds.npy", cameras, np.array(bounds))
    write_colmap(folder / "sparse" / "0", cameras, np.concatenate(points), np.concatenate(colors))


def _check_folder(out: Path, overwrite: bool) -> None:
    """Raise if `out` holds what must not be replaced."""
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"synthesize(): {out} is a file; give another folder.")
    occupied = out.is_dir() and any(out.iterdir())
    if occupied and not overwrite:
        raise FileExistsError(f"synthesize(): {out} is not empty; give another folder or set overwrite.")
    if occupied and not (out / "capture.json").is_file():
        raise FileExistsError(f"synthesize(): {out} holds no capture, so it is not replaced; give another folder.")

"""Light that an inserted sphere receives from the fit of an HDR recording, and from the fit of one
of 8 bits.

    python -m benchmarks.reports.hdr --json benchmarks/results/hdr.json --picture
    docs/experiments/hdr.jpg

A room without a ceiling, with a lamp and a metal sphere that moves, is path-traced in linear light.
It is recorded twice: as EXR files, and as PNG files, which clip the lamp and its reflections at
white. Both recordings are fitted with the same settings. A diffuse white sphere is lit by the
`light_probe` of each fit. The truth is a path-traced image of the room with the sphere in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import tyro

import morgs_mi
from benchmarks.speed.output import Output
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.codec.frame_source import play
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import decode_light, display_image, unit_values
from morgs_mi.core.files import write_json
from morgs_mi.evaluate.evaluate import evaluate_stream
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.io.exr import write_exr
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.playback.visualise import contact_sheet, label, write_png
from morgs_mi.runs.fit_capture import stream_capture
from morgs_mi.studio.light.insert import InsertConfig, render_inserted
from morgs_mi.studio.light.light_probe import CLIPPED, light_probe
from morgs_mi.studio.synth.scene import Rig

RIG = Rig(center=(0, 0.75, 0), distance=4.0, fov=44.0)
FRAMES = 3
FPS = 30
# Place and radius of the inserted sphere, where the room is empty.
PLACE = (0.1, 0.7, 0.35)
RADIUS = 0.25
# Radius of the sphere on which the light is measured: it hardly changes the light of the room.
_SMALL = 0.01
_NORMALS = 400
_SAMPLES = 1024
_POINTS = 1500
# Rows of the light probe: a texel is smaller than the lamp.
_HEIGHT = 128
_JPEG_QUALITY = 90


@dataclass(frozen=True)
class Options(Output):
    """Compare the light of the fits of an HDR recording and of one of 8 bits."""

    out: Path = Path("out/hdr")
    """Folder of the recordings and the fits; those that are there are used."""
    picture: Path | None = None
    """JPEG file for the picture."""
    width: int = 200
    """Width of the images; 3/4 of it is their height."""
    spp: int = 512
    """Samples per pixel of the recordings."""
    cameras: int = 8
    """Cameras, of which the first is held out."""
    gaussians: int = 8000
    """Number of Gaussians."""
    steps: int = 1000
    """Steps of the first frame."""
    variant: str = "llvm_ad_rgb"
    """Variant of Mitsuba."""


def diffuse(*color: float) -> dict[str, Any]:
    """Return a material of one colour."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}}


def checkered(*color: float) -> dict[str, Any]:
    """Return a material with a pattern, which a fit can hold on to."""
    dark = {"type": "rgb", "value": [0.6 * c for c in color]}
    bright = {"type": "rgb", "value": list(color)}
    scale = mi.ScalarTransform4f().scale([8, 8, 1])
    return {
        "type": "diffuse",
        "reflectance": {"type": "checkerboard", "color0": dark, "color1": bright, "to_uv": scale},
    }


def room(frame: int, **more: dict[str, Any]) -> Any:
    """Return the scene of a frame, with further objects."""
    to = mi.ScalarTransform4f
    side = {"type": "rectangle", "bsdf": checkered(0.7, 0.3, 0.2)}
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": to().rotate([1, 0, 0], -90).scale(2),
                "bsdf": checkered(0.7, 0.7, 0.65),
            },
            "back": {
                "type": "rectangle",
                "to_world": to().translate([0, 1, -1.6]).scale([2, 1.6, 1]),
                "bsdf": checkered(0.55, 0.6, 0.7),
            },
            "left": {
                **side,
                "to_world": to().translate([-1.6, 1, 0]).rotate([0, 1, 0], 90).scale([2, 1.6, 1]),
            },
            "right": {
                **side,
                "to_world": to().translate([1.6, 1, 0]).rotate([0, 1, 0], -90).scale([2, 1.6, 1]),
            },
            "lamp": {
                "type": "sphere",
                "center": [-0.75, 1.45, -0.7],
                "radius": 0.16,
                "emitter": {
                    "type": "area",
                    "radiance": {"type": "rgb", "value": [34.0, 27.0, 18.0]},
                },
            },
            "metal": {
                "type": "sphere",
                "center": [0.75 - 0.03 * frame, 0.4, -0.5],
                "radius": 0.4,
                "bsdf": {"type": "roughconductor", "material": "Al", "alpha": 0.08},
            },
            **more,
        }
    )


def traced(scene: Any, camera: Camera, spp: int, seed: int) -> np.ndarray:
    """Return the linear light of a view [H, W, 3]."""
    integrator: Any = mi.load_dict({"type": "path", "max_depth": 6})
    render: Any = mi.render
    sensor: Any = mi.load_dict(camera.sensor())
    return np.array(render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed))[
        ..., :3
    ]


def record(options: Options) -> dict[str, Path]:
    """Write both recordings unless they are there, and return their folders by name."""
    folders = {name: options.out / name for name in ("hdr", "8-bit")}
    cameras = RIG.cameras(options.cameras, options.width, options.width * 3 // 4)
    if all((folder / "capture.json").exists() for folder in folders.values()):
        return folders
    for frame in range(FRAMES):
        scene = room(frame)
        for view, camera in enumerate(cameras):
            light = traced(scene, camera, options.spp, seed=view + 100 * frame)
            for folder in folders.values():
                (folder / camera.name).mkdir(parents=True, exist_ok=True)
            planes = {name: light[..., k] for k, name in enumerate("RGB")}
            write_exr(folders["hdr"] / camera.name / f"{frame:04d}.exr", planes)
            write_png(folders["8-bit"] / camera.name / f"{frame:04d}.png", display_image(light))
    points, colors = surface_points(cameras[1:])
    for folder in folders.values():
        write_colmap(folder / "sparse" / "0", cameras, points, colors)
        # Both are compared as a display shows them at the exposure of the recording of 8 bits.
        write_json(folder / "capture.json", {"test_view": 0, "fps": FPS, "display_exposure": 0})
    return folders


def surface_points(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the surfaces that the cameras see in the first frame, and their colours in
    [0, 1].
    """
    rng = np.random.default_rng(0)
    scene = room(0)
    points = []
    colors = []
    for camera in cameras:
        pixels = rng.uniform(0, (camera.width, camera.height), (_POINTS // len(cameras), 2))
        position, directions = camera.rays(pixels)
        origins = np.repeat(position[:, None], len(directions), axis=1)
        hit: Any = scene.ray_intersect(mi.Ray3f(mi.Point3f(origins), mi.Vector3f(directions.T)))
        valid = np.array(hit.is_valid())
        points.append(np.array(hit.p).T[valid])
        picture = display_image(traced(scene, camera, 16, seed=1))
        columns, rows = pixels[valid].astype(int).T
        colors.append(unit_values(picture[rows, columns]))
    return np.concatenate(points), np.concatenate(colors)


def normals() -> np.ndarray:
    """Return directions [K, 3], evenly distributed on the sphere."""
    k = np.arange(_NORMALS) + 0.5
    y = 1 - 2 * k / _NORMALS
    angle = np.pi * (1 + np.sqrt(5)) * k
    return np.stack(
        [np.sqrt(1 - y * y) * np.cos(angle), y, np.sqrt(1 - y * y) * np.sin(angle)], axis=1
    )


def received(scene: Any) -> np.ndarray:
    """Return the light that the `small_ball` in a scene reflects at its `normals` [K, 3]."""
    directions = np.repeat(normals(), _SAMPLES, axis=0)
    origins = np.array(PLACE) + 1.5 * _SMALL * directions
    ray: Any = mi.RayDifferential3f(mi.Point3f(origins.T), mi.Vector3f(-directions.T))
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(directions))
    integrator: Any = mi.load_dict({"type": "path", "max_depth": 6})
    light = np.array(integrator.sample(scene, sampler, ray, None, mi.Bool(True))[0])
    return light.T.reshape(_NORMALS, _SAMPLES, 3).mean(axis=1)


def small_ball() -> dict[str, Any]:
    """Return the white sphere on which the light is measured."""
    return {"type": "sphere", "center": list(PLACE), "radius": _SMALL, "bsdf": diffuse(1, 1, 1)}


def compare(light: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return the mean absolute error of the received light, and its mean, both relative to the true
    mean.
    """
    return {
        "error": round(float(np.abs(light - truth).mean() / truth.mean()), 4),
        "mean": round(float(light.mean() / truth.mean()), 4),
    }


def main(options: Options) -> None:
    """Record, fit and compare."""
    mi.set_variant(options.variant)
    folders = record(options)
    fit = FitConfig(num_gaussians=options.gaussians, first_frame_steps=options.steps, epochs=2)
    streams = {}
    for name, folder in folders.items():
        if not (options.out / f"fit-{name}" / "stream.morgs").exists():
            stream_capture(
                morgs_mi.load_capture(folder), options.out / f"fit-{name}", StreamConfig(fit)
            )
        streams[name] = morgs_mi.open_stream(options.out / f"fit-{name}")
    truth = received(room(0, ball=small_ball()))
    rows: dict[str, Any] = {}
    for name, stream, white in (
        ("hdr", streams["hdr"], 1.0),
        ("8-bit", streams["8-bit"], 1.0),
        ("8-bit, guessed", streams["8-bit"], CLIPPED),
    ):
        lamp = probe(stream, white)
        rows[name] = compare(
            received(mi.load_dict({"type": "scene", "ball": small_ball(), "light": lamp})), truth
        )
    scores = {name: evaluate_stream(options.out / f"fit-{name}") for name in streams}
    for name, result in scores.items():
        rows[name] |= {"psnr": round(result.scores.psnr, 2), "bytes": result.sizes.file}
    rows["hdr"]["psnr_mu"] = round(scores["hdr"].scores.psnr_mu, 2)
    settings = {
        key: value
        for key, value in asdict(options).items()
        if key not in ("json", "out", "picture")
    }
    options.write({"light": rows, "options": settings})
    if options.picture is not None:
        picture = cv2.cvtColor(draw(streams, options), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(options.picture), picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def probe(stream: Any, clipped: float) -> dict[str, Any]:
    """Return the light at `PLACE` in the first frame of a stream; behind the cameras it is black,
    as in truth.
    """
    return light_probe(first_gaussians(stream), PLACE, _HEIGHT, clipped=clipped)


def first_gaussians(stream: Any) -> Any:
    """Return the Gaussians of the first frame."""
    return next(gaussians for _, gaussians in play(stream))


def as_given(entries: dict[str, Any], frame: int, time: float) -> dict[str, Any]:
    """Return the entries of an inserted scene, which are the same in all frames."""
    return entries


def draw(streams: Mapping[str, Any], options: Options) -> np.ndarray:
    """Return the truth beside both fits: at the recordings' exposure, 4 stops darker, and with a
    white sphere.
    """
    camera = RIG.cameras(options.cameras, options.width, options.width * 3 // 4)[0]
    lamps = {
        name: probe(stream, 1.0 if name == "hdr" else CLIPPED) for name, stream in streams.items()
    }
    camera = camera.resized(2 * camera.width, 2 * camera.height)
    ball = {
        "type": "sphere",
        "center": list(PLACE),
        "radius": RADIUS,
        "bsdf": diffuse(0.9, 0.9, 0.9),
    }
    rows = {"truth": (traced(room(0), camera, 256, 7), traced(room(0, ball=ball), camera, 256, 8))}
    for name, stream in streams.items():
        plain = np.asarray(morgs_mi.rasterize(first_gaussians(stream), camera).color)
        # The map itself would shine through walls that are not quite opaque.
        integrator = {"type": "path", "hide_emitters": True}
        entries = {"ball": ball, "light": lamps[name], "integrator": integrator}
        (_, images), *_ = render_inserted(
            stream,
            camera,
            partial(as_given, entries),
            [0],
            ("color",),
            InsertConfig(128, shadows=False),
        )
        light_images = (decode_light(image) for image in (plain, images["color"]))
        rows[f"fit of the {name} recording"] = next(light_images), next(light_images)
    return contact_sheet(
        [
            [
                label(display_image(plain, 0), name),
                label(display_image(plain, -4), "4 stops darker"),
                label(display_image(with_sphere, 0), "with a white sphere"),
            ]
            for name, (plain, with_sphere) in rows.items()
        ]
    )


if __name__ == "__main__":
    main(tyro.cli(Options))

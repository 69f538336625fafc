"""A Mitsuba scene inserted into a stream: its objects stand among the Gaussians of every frame.

A scene is an XML file, which is the same in all frames, or a Python file with a function

    build(frame: int, time: float) -> dict

that returns the entries of a Mitsuba scene: shapes, emitters, and optionally an `integrator` for
them. The time is in seconds. World space, its origin and its units are the stream's.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import cv2
import mitsuba as mi
import numpy as np

from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.core.camera import Camera
from morgs_mi.core.checks import LARGEST, bounded, few, require
from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.core.config import Count, check_ranges
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.extras.light.light_probe import CLIPPED, light_probe
from morgs_mi.extras.light.shadows import shadow_ratio, shadowed
from morgs_mi.extras.synth.scene import build_of, failures_in
from morgs_mi.gaussian_integrator import ellipsoids
from morgs_mi.playback.export.clips import frame_numbers
from morgs_mi.playback.player import available_channels
from morgs_mi.render.channels import exr_names
from morgs_mi.render.rasterize import rasterize
from morgs_mi.surfaces.surface_view import lights, rays_for, traced

LAYERS = ("splats", "surfaces", "shadow")
"""Further channels, for compositing: the splats alone and the surfaces alone, in linear light with
alpha, and the shadow of the surfaces on the splats, a factor of their linear light."""

Light = Literal["probe", "traced"]

Build = Callable[[int, float], dict[str, Any]]

_PLACE = "The inserted scene"  # where its errors begin


@dataclass(frozen=True)
class InsertConfig:
    """Rendering of an inserted scene."""

    samples: Count = 16
    """Samples per pixel of its surfaces."""
    shadows: bool = True
    """Whether its surfaces throw shadows on the Gaussians, see `shadow_ratio`."""
    light: Light = "probe"
    """``probe`` lights the surfaces by an environment map, see `light_probe`; ``traced`` traces
    rays through the Gaussians (`splat_path`), which also throw shadows on them."""
    clipped: float | None = None
    """Radiance of colours that the video clipped at 1, see `light_probe`; None: 4, or 1 for a
    stream of an HDR recording, which is not clipped."""

    def __post_init__(self) -> None:
        check_ranges(self, "render_inserted()")


def load_insert(path: str | Path) -> Build:
    """Return the function (frame, seconds) -> entries of a Mitsuba scene of an XML or Python file.

    Raises:
        ValueError: there is no such file, it is of another type, or it fails; the sentence names
            the file, and the line of a Python file.
    """
    path = Path(path)
    require(
        path.suffix in (".xml", ".py") and path.is_file(),
        str(path),
        "expected a scene to insert, FILE.xml or FILE.py",
        repr(path.suffix) if path.is_file() else "none",
        "check the path",
    )
    if path.suffix == ".xml":
        with _mitsuba_errors_at(str(path)):
            scene: Any = mi.load_file(str(path))
        entries = {part.id() or f"part{i}": part for i, part in enumerate(_parts(scene))}
        # Mitsuba adds an integrator to files without one.
        if ElementTree.parse(path).find("integrator") is not None:
            entries["integrator"] = scene.integrator()
        return lambda frame, time: entries
    build = build_of(path, "build(frame, time) -> dict")

    def build_entries(frame: int, time: float) -> dict[str, Any]:
        with failures_in(path):
            entries = build(frame, time)
            if not isinstance(entries, dict):
                raise TypeError(f"`build` must return a dict, got a {type(entries).__name__}")
            return entries

    return build_entries


def inserted_channels(stream: FrameSource) -> tuple[str, ...]:
    """Return all channels of a stream with an inserted scene, for EXR files.

    Raises:
        ValueError: a broken packet, or no frame.
    """
    frame_numbers(stream)
    _, gaussians = next(iter(play(stream)))
    return (
        "color",
        "alpha",
        *(name for name in available_channels(gaussians) if name != "color"),
        *LAYERS,
    )


def selected(stream: FrameSource, frames: Sequence[int]) -> list[int]:
    """Return `frames` in ascending order, each once.

    Raises:
        ValueError: the stream does not have one of them.
    """
    numbers = frame_numbers(stream)
    missing_frames = sorted(set(frames) - set(numbers))
    requirement = f"the frames must be out of {numbers[0]} to {numbers[-1]}"
    require(not missing_frames, str(stream.path), requirement, few(missing_frames), "choose others")
    return sorted(set(frames))


def render_inserted(
    stream: FrameSource,
    camera: Camera,
    build: Build,
    frames: Sequence[int] | None = None,
    channels: Sequence[str] = ("color",),
    config: InsertConfig | None = None,
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Render frames of a stream for one camera with a Mitsuba scene inserted.

    An inserted scene without emitters is lit by the Gaussians. A capture rarely shows what is
    behind the cameras; there, the light has the mean colour of the view.

    Args:
        stream: the file.
        camera: any view.
        build: see `load_insert`.
        frames: indices of the frames to render; None: all.
        channels: out of ``color``, ``alpha``, the AOVs of `gaussian_splat`, and `LAYERS`.
        config: settings.

    Yields:
        (frame, images) as `render_stream` does.

    Raises:
        ValueError: a broken packet, or a scene that Mitsuba or `gaussian_splat` refuses.
    """
    config = config or InsertConfig()
    if config.clipped is None:
        config = replace(config, clipped=1.0 if "transfer" in stream.metadata else CLIPPED)
    view = camera.square()
    for frame, gaussians in play(stream):
        if frames is None or frame in frames:
            entries = build(frame, frame / stream.fps)
            images = _render(gaussians, view, entries, channels, config)
            if view.height != camera.height:
                size = camera.size
                for name, image in images.items():
                    values = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
                    images[name] = values.reshape(camera.height, camera.width, -1)
                if "motion" in images:  # in pixels
                    images["motion"] *= np.array([1, camera.height / view.height], np.float32)
            yield frame, images


def _mean_color(gaussians: Gaussians, camera: Camera, clipped: float) -> list[float]:
    image = np.asarray(rasterize(gaussians, camera, ("color",)).color)
    return np.clip(image, 0, np.inf if clipped == 1 else 1.0).mean((0, 1)).tolist()


def _render(
    gaussians: Gaussians,
    camera: Camera,
    entries: dict[str, Any],
    channels: Sequence[str],
    config: InsertConfig,
) -> dict[str, np.ndarray]:
    entries = {name: value for name, value in entries.items() if name not in ("type", "sensor")}
    clipped: Any = config.clipped
    is_traced = config.light == "traced"
    usual = {"type": "splat_path", "clipped": clipped} if is_traced else {"type": "path"}
    entry = entries.pop("integrator", None) or usual
    nested: Any = mi.load_dict(entry) if isinstance(entry, dict) else entry
    article = "an" if is_traced else "no"
    require(
        hasattr(nested, "splats") == is_traced,
        _PLACE,
        f"with light {config.light!r}, expected {article} integrator `splat_path`",
        type(nested).__name__ if hasattr(nested, "splats") else nested.class_name(),
        "remove `integrator` from the scene, or choose the other light",
    )
    ratio = np.ones(len(gaussians), np.float32)
    with _mitsuba_errors_at(_PLACE):
        surfaces, lit_scene = _lit_scenes(entries, gaussians, camera, config.light, clipped)
        if config.shadows:
            ratio = shadow_ratio(gaussians, lit_scene, camera.position)
        dark = shadowed(gaussians, ratio)
        images = _plugin_images(dark, camera, surfaces, nested, channels, config.samples)
        if "surfaces" in channels:
            sensor = _sensor(camera)
            with traced(nested, rays_for(nested, dark), srgb=True):
                images["surfaces"] = np.asarray(nested.render(surfaces, sensor, spp=config.samples))
    if {"splats", "shadow"} & set(channels):
        image = rasterize(gaussians, camera)
        bright = decode_light(np.asarray(image.color))
        shaded = decode_light(np.asarray(rasterize(dark, camera).color))
        images["splats"] = np.concatenate([bright, np.asarray(image.alpha)], axis=2)
        images["shadow"] = np.where(bright > 0, shaded / np.maximum(bright, 1e-6), 1)
    return {name: images[name].astype(np.float32) for name in channels}


def _lit_scenes(
    entries: dict[str, Any], gaussians: Gaussians, camera: Camera, light: Light, clipped: float
) -> tuple[Any, Any]:
    """Return the inserted scene with the lights of its surfaces, and with those that throw shadows
    on the Gaussians.

    Raises:
        ValueError: it has no shapes, or they are not finite.
    """
    scene: Any = mi.load_dict({"type": "scene", **entries})
    parts = scene.shapes() or scene.emitters()
    require(parts, _PLACE, "expected at least one shape", "none", "add one")
    box = scene.bbox()
    require(
        not scene.shapes() or bounded(np.array([box.min, box.max])),
        _PLACE,
        f"expected shapes within {LARGEST:g} world units",
        f"{box.min} to {box.max}",
        "correct their places and sizes",
    )
    if scene.emitters():
        return scene, scene
    color = _mean_color(gaussians, camera, clipped)
    center = np.array(box.center()).ravel()
    lamp = light_probe(gaussians, center, background=color, clipped=clipped)
    lit_scene = mi.load_dict({"type": "scene", **entries, "captured light": lamp})
    if light == "probe":
        return lit_scene, lit_scene
    # The surfaces get the light of the Gaussians by rays, and here what comes from behind them.
    radiance = decode_light(np.array(color)).tolist()
    lamp = {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}
    return mi.load_dict({"type": "scene", **entries, "captured light": lamp}), lit_scene


def _plugin_images(
    gaussians: Gaussians,
    camera: Camera,
    surfaces: Any,
    nested: Any,
    channels: Sequence[str],
    samples: int,
) -> dict[str, np.ndarray]:
    """Return the colour, alpha and AOVs of `gaussian_splat` with an inserted scene."""
    aovs = [name for name in channels if name not in ("color", "alpha", *LAYERS)]
    integrator = {"type": "gaussian_splat", "surfaces": nested, "aovs": ",".join(aovs)}
    scene = mi.load_dict(
        {
            "type": "scene",
            "gaussians": ellipsoids(gaussians),
            "sensor": _sensor(camera),
            "integrator": integrator,
            **{f"part{i}": part for i, part in enumerate(_parts(surfaces))},
        }
    )
    image = np.asarray(scene.integrator().render(scene, spp=samples))
    images = {"color": encode_light(image[..., :3]), "alpha": image[..., 3:4]}
    first = 4
    for name in aovs:
        size = len(exr_names(name))
        images[name] = image[..., first : first + size]
        first += size
    return images


def _sensor(camera: Camera) -> Any:
    return mi.load_dict(camera.sensor(pixel_format="rgba"))


@contextmanager
def _mitsuba_errors_at(place: str) -> Iterator[None]:
    """Raise `ValueError` with Mitsuba's reason in one line, without the places in its source."""
    try:
        yield
    except RuntimeError as error:
        reason = re.sub(r"\[\w+\.\w+:\d+\] ", "", " ".join(str(error).split())).rstrip(".")
        raise ValueError(f"{place}: {reason}; correct the scene.") from error


def _parts(scene: Any) -> list[Any]:
    """Return the shapes of a scene, and its emitters that are not on one."""
    return [*scene.shapes(), *lights(scene)]

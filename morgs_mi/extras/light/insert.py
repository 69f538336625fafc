"""A Mitsuba scene inserted into a stream: its objects stand among the Gaussians of every frame.

A scene is an XML file, which is the same in all frames, or a Python file with a function

    build(frame: int, time: float) -> dict

that returns the entries of a Mitsuba scene: shapes, emitters, and optionally an `integrator` for
them. The time is in seconds. World space, its origin and its units are the stream's.

Shadows of inserted surfaces on Gaussians, by differential rendering (Debevec 1998).

The colour of a Gaussian is light that it reflected in the recording. Inserted surfaces scale it by
the ratio of the irradiance with and without them, from the same lights. The ratio is traced from
the Gaussian's centre, with the same directions in numerator and denominator: it is exactly 1 where
nothing is in the way.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from morgs_mi.codec.frame_source import FrameSource, play
from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import SH_C0, decode_light, encode_light
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.geometry import covariances
from morgs_mi.core.types import Arrays, Float, SceneDict, UInt32, Vector3f
from morgs_mi.extras.light.light_probe import CLIPPED, check_point, light_probe
from morgs_mi.gaussian_integrator import ellipsoids
from morgs_mi.io.scene_file import build_of, failures_in
from morgs_mi.platform.checks import (
    LARGEST,
    bounded,
    check_number,
    check_type,
    few,
    numbers,
    require,
)
from morgs_mi.platform.config import Count, config_class, config_or_default
from morgs_mi.playback.export.clips import frame_numbers
from morgs_mi.playback.player import available_channels
from morgs_mi.render.channels import channel_sizes
from morgs_mi.render.rasterize import rasterize
from morgs_mi.surfaces.surface_view import lights, rays_for, shared_scene, traced

LAYERS = ("splats", "surfaces", "shadow")
"""Further channels, for compositing: the splats alone and the surfaces alone, in linear light with
alpha, and the shadow of the surfaces on the splats, a factor of their linear light."""

Lighting = Literal["probe", "traced"]

Build = Callable[[int, float], SceneDict]

_PLACE = "The inserted scene"  # where its errors begin
# Gaussians around one that determine the surface it lies on.
_NEIGHBOURS = 16


@config_class
class InsertConfig:
    """Rendering of an inserted scene."""

    samples: Count = 16
    """Samples per pixel of its surfaces."""
    shadows: bool = True
    """Whether its surfaces throw shadows on the Gaussians, see `shadow_ratio`."""
    light: Lighting = "probe"
    """``probe`` lights the surfaces by an environment map, see `light_probe`; ``traced`` traces
    rays through the Gaussians (`splat_path`), which also throw shadows on them."""
    clipped: float | None = None
    """Radiance of colours that the video clipped at 1, see `light_probe`; None: 4, or 1 for a
    stream of an HDR recording, which is not clipped."""


def load_insert(path: str | Path) -> Build:
    """Return the function (frame, seconds) -> entries of a Mitsuba scene of an XML or Python file.

    Raises:
        ValueError: there is no such file, it is of another type, or it fails; the sentence names
            the file, and the line of a Python file.
    """
    path = Path(path)
    require(
        path.suffix in (".xml", ".py") and path.is_file(),
        path,
        "expected a scene to insert, FILE.xml or FILE.py",
        repr(path.suffix) if path.is_file() else "none",
        "check the path",
    )
    if path.suffix == ".xml":
        with _mitsuba_errors_at(path):
            scene: mi.Scene = mi.load_file(str(path))
        entries = {part.id() or f"part{i}": part for i, part in enumerate(_parts(scene))}
        # Mitsuba adds an integrator to files without one.
        if ElementTree.parse(path).find("integrator") is not None:
            entries["integrator"] = scene.integrator()
        return lambda frame, time: entries
    build = build_of(path, "build(frame, time) -> dict")

    def build_entries(frame: int, time: float) -> SceneDict:
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
    require(
        not missing_frames,
        stream.path,
        f"the frames must be out of {numbers[0]} to {numbers[-1]}",
        few(missing_frames),
        "choose others",
    )
    return sorted(set(frames))


def render_inserted(
    stream: FrameSource,
    camera: Camera,
    build: Build,
    frames: Sequence[int] | None = None,
    channels: Sequence[str] = ("color",),
    config: InsertConfig | None = None,
) -> Iterator[tuple[int, Arrays]]:
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
    config = config_or_default("render_inserted()", config, InsertConfig())
    if config.clipped is None:
        config = replace(config, clipped=1.0 if "transfer" in stream.metadata else CLIPPED)
    view = camera.square()
    for frame, gaussians in play(stream):
        if frames is None or frame in frames:
            images = _render(gaussians, view, build(frame, frame / stream.fps), channels, config)
            if view.height != camera.height:
                for name, image in images.items():
                    values = cv2.resize(image, camera.size, interpolation=cv2.INTER_LINEAR)
                    images[name] = values.reshape(camera.height, camera.width, -1)
                if "motion" in images:  # in pixels
                    images["motion"] *= np.array([1, camera.height / view.height], np.float32)
            yield frame, images


def _render(
    gaussians: Gaussians,
    camera: Camera,
    entries: SceneDict,
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
        aovs = [name for name in channels if name not in ("color", "alpha", *LAYERS)]
        integrator = {"type": "gaussian_splat", "surfaces": nested, "aovs": ",".join(aovs)}
        scene = mi.load_dict(
            {
                "type": "scene",
                "gaussians": ellipsoids(dark),
                "sensor": _sensor(camera),
                "integrator": integrator,
                **{f"part{i}": part for i, part in enumerate(_parts(surfaces))},
            }
        )
        image = np.asarray(scene.integrator().render(scene, spp=config.samples))
        images = {"color": encode_light(image[..., :3]), "alpha": image[..., 3:4]}
        first = 4
        for name in aovs:
            size = channel_sizes()[name]
            images[name] = image[..., first : first + size]
            first += size
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
    entries: SceneDict, gaussians: Gaussians, camera: Camera, light: Lighting, clipped: float
) -> tuple[Any, Any]:
    """Return the inserted scene with the lights of its surfaces, and with those that throw shadows
    on the Gaussians.

    Raises:
        ValueError: it has no shapes, or they are not finite.
    """
    scene: mi.Scene = mi.load_dict({"type": "scene", **entries})
    require(
        scene.shapes() or scene.emitters(), _PLACE, "expected at least one shape", "none", "add one"
    )
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
    image = np.asarray(rasterize(gaussians, camera, ("color",)).color)
    color = np.clip(image, 0, np.inf if clipped == 1 else 1.0).mean((0, 1)).tolist()
    lamp = light_probe(gaussians, np.array(box.center()).ravel(), background=color, clipped=clipped)
    lit_scene = mi.load_dict({"type": "scene", **entries, "captured light": lamp})
    if light == "probe":
        return lit_scene, lit_scene
    # The surfaces get the light of the Gaussians by rays, and here what comes from behind them.
    radiance = decode_light(np.array(color)).tolist()
    lamp = {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}
    return mi.load_dict({"type": "scene", **entries, "captured light": lamp}), lit_scene


def _sensor(camera: Camera) -> Any:
    return mi.load_dict(camera.sensor(pixel_format="rgba"))


@contextmanager
def _mitsuba_errors_at(place: object) -> Iterator[None]:
    """Raise `ValueError` with Mitsuba's reason in one line, without the places in its source."""
    try:
        yield
    except RuntimeError as error:
        reason = re.sub(r"\[\w+\.\w+:\d+\] ", "", " ".join(str(error).split())).rstrip(".")
        raise ValueError(f"{place}: {reason}; correct the scene.") from error


def _parts(scene: mi.Scene) -> list[Any]:
    """Return the shapes of a scene, and its emitters that are not on one."""
    return [*scene.shapes(), *lights(scene)]


def shadow_ratio(
    gaussians: Gaussians, scene: mi.Scene, viewpoint: ArrayLike, samples: int = 256
) -> np.ndarray:
    """Return the ratio of each Gaussian's irradiance with and without a scene's surfaces, float32
    [N] in [0, 1].

    An approximation: light travels straight from the lights to the centre of a Gaussian. Where the
    Gaussians around it form a surface, it receives light on the side that faces the viewpoint, by
    the cosine; elsewhere from everywhere. Shadows among Gaussians, and light that surfaces reflect,
    are not computed. It has no gradient.

    Args:
        gaussians: N Gaussians.
        scene: Mitsuba scene with the surfaces and the lights of the recording, such as a
            `light_probe`; its `ellipsoids` are ignored.
        viewpoint: a point [3] from which the captured surfaces are seen, world units: a camera's
            position.
        samples: directions per light; they are the same for all Gaussians, and shadows have no
            noise.

    Raises:
        ValueError: a bad argument, or a scene without an emitter.
    """
    place = "shadow_ratio()"
    check_type(place, "gaussians", gaussians, Gaussians)
    check_number(place, "samples", samples, "[1, 65536]")
    eye = check_point(place, "viewpoint", viewpoint)
    emitters = scene.emitters()
    shapes = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
    require(
        emitters,
        place,
        "expected a scene with an emitter",
        "none",
        "add one, such as an `envmap` of morgs_mi.light_probe()",
    )
    if not len(gaussians) or not shapes:
        return np.ones(len(gaussians), np.float32)
    with dr.suspend_grad():
        receivers = _Receivers(gaussians, eye)
        blockers = shared_scene(shapes, scene)
        blocked = mi.Float(0)
        total = mi.Float(0)
        for emitter in emitters:
            some, every = _irradiance(emitter, receivers, blockers, int(samples))
            blocked = blocked + some
            total = total + every
        return np.array(1 - dr.select(total > 0, blocked / total, 0))


def shadowed(gaussians: Gaussians, ratio: np.ndarray) -> Gaussians:
    """Return Gaussians with their colours scaled by a ratio [N] of linear light, see
    `shadow_ratio`.

    The colours are sRGB-encoded. Their dependence on direction is scaled by the factor of the mean
    colour.

    Raises:
        ValueError: a ratio of another shape, or with numbers that are negative or not finite.
    """
    ratio = numbers("shadowed()", "ratio", ratio).astype(np.float64)
    require(
        ratio.shape == (len(gaussians),) and (np.isfinite(ratio) & (ratio >= 0)).all(),
        "shadowed()",
        f"`ratio` must be [N] with N={len(gaussians)}, finite and not negative",
        list(ratio.shape),
        "pass the result of shadow_ratio()",
    )
    # The mean colours [N, 1, 3].
    mean = np.maximum(0.5 + SH_C0 * np.array(dr.detach(gaussians.sh_coeffs))[:, :1], 1e-6)
    factor = encode_light(ratio[:, None, None] * decode_light(mean)) / mean
    shift = np.zeros((1, int(gaussians.sh_coeffs.shape[1]), 1))
    shift[:, 0] = 0.5 / SH_C0  # factor (0.5 + SH) = 0.5 + SH of the new coefficients
    scale = from_numpy(mi.TensorXf, np.broadcast_to(factor, gaussians.sh_coeffs.shape))
    return replace(
        gaussians,
        sh_coeffs=gaussians.sh_coeffs * scale + from_numpy(mi.TensorXf, (factor - 1) * shift),
    )


class _Receivers:
    """Centres and orientation of the Gaussians: `flat` is 0 in a round neighbourhood and 1 on a
    plane. Single Gaussians of a fitted surface lie in it, but are not all flat.
    """

    def __init__(self, gaussians: Gaussians, eye: np.ndarray) -> None:
        means = np.array(dr.detach(gaussians.means), np.float64)
        mixture = _mixture(means, np.array(dr.detach(gaussians.opacities), np.float64))
        # The covariance of the mixture: the mean of its second moments, minus the second moment of
        # its centre.
        centered = means - means.mean(0)
        centers = mixture @ centered
        moments = covariances(gaussians) + centered[:, :, None] * centered[:, None]
        mean_moments = (mixture @ moments.reshape(-1, 9)).reshape(-1, 3, 3)
        variances, directions = np.linalg.eigh(
            mean_moments - centers[:, :, None] * centers[:, None]
        )
        normals = directions[:, :, 0]  # the thinnest direction
        is_back = np.sum(normals * (eye - means), axis=1) < 0
        normals = np.where(is_back[:, None], -normals, normals)
        self.centers = dr.unravel(mi.Point3f, from_numpy(mi.Float, means))
        self.normals = dr.unravel(mi.Vector3f, from_numpy(mi.Float, normals))
        self.flat = from_numpy(mi.Float, 1 - variances[:, 0] / np.maximum(variances[:, 1], 1e-30))

    def response(self, direction: Vector3f) -> Float:
        """Return the received fraction of light from a direction."""
        return dr.lerp(0.5, dr.maximum(dr.dot(self.normals, direction), 0), self.flat)


def _mixture(means: np.ndarray, opacities: np.ndarray) -> csr_array:
    """Return the weights [N, N] of the Gaussians around each one, by their opacities [N]."""
    _, near = KDTree(means).query(means, min(_NEIGHBOURS, len(means)), workers=-1)
    near = near.reshape(len(means), -1)
    # An opacity may be 0 in float32.
    weights = opacities[near] + 1e-9
    weights /= weights.sum(1, keepdims=True)
    ends = np.arange(0, near.size + 1, near.shape[1])
    return csr_array((weights.ravel(), near.ravel(), ends), shape=(len(means), len(means)))


@dr.syntax
def _irradiance(
    emitter: mi.Emitter, receivers: _Receivers, blockers: Any, samples: int
) -> tuple[Float, Float]:
    """Return the irradiance of one light that surfaces block, and that without surfaces."""
    far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
    it = dr.zeros(mi.Interaction3f, dr.width(receivers.centers))
    it.p = receivers.centers
    count = dr.opaque(mi.UInt32, samples)
    step_size = dr.opaque(mi.Float, 1 / samples)
    no_scramble: Any = 0

    k: UInt32 = mi.UInt32(0)
    blocked = mi.Float(0)
    total = mi.Float(0)
    while dr.hint(k < count, label="shadow"):
        sample = mi.Point2f((mi.Float(k) + 0.5) * step_size, mi.radical_inverse_2(k, no_scramble))
        ds, weight = emitter.sample_direction(it, sample)
        irradiance = dr.mean(mi.unpolarized_spectrum(weight)) * receivers.response(ds.d)
        ray = mi.Ray3f(receivers.centers, ds.d)
        if dr.hint(not far, mode="scalar"):
            ray.maxt = ds.dist * (1 - 1e-4)
        blocked += dr.select(blockers.ray_test(ray, irradiance > 0), irradiance, 0)
        total += irradiance
        k += 1
    return blocked, total

"""Error and run time of the renderer's settings: compared with a float64 reference implementation.

One scene, one setting changed at a time. The *exact* image has no cut-offs and no early stop. The *rounding* error
compares with a reference that has the same `alpha_min`, so that only float32 and the early stop remain. Errors are
measured on a sample of pixels: the loss whose gradients are compared has random weights at these pixels and zero
weights elsewhere. So the renderer runs unchanged while the reference stays affordable.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.reports.plots import blank_figure, label_points, markdown, save_figure
from benchmarks.reports.records import Record
from benchmarks.reports.reference64 import ATTRIBUTES, Reference64
from benchmarks.workloads import ball
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.evaluate.environment import machine, versions
from morgs_mi.render.backend import block_shape
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize

__all__ = [
    "Errors",
    "GradientError",
    "ImageError",
    "RendererReportConfig",
    "RendererResult",
    "RendererRow",
    "markdown_table",
    "plot_renderer",
    "report_renderer",
]

_MARKS = {"block": "s", "reproducible": "D"}
_EXACT_ALPHA_MIN = 1e-12  # smaller values do not change a float32 image


@dataclass(frozen=True)
class RendererReportConfig:
    """Scene and measurement of the renderer's report."""

    gaussians: int = 20_000
    """Number of Gaussians, uniform in a ball of radius 1 that fills the view."""
    width: int = 512
    """Width of the image, px."""
    height: int = 384
    """Height of the image, px."""
    median_scale: float = 0.02
    """Median standard deviation of a Gaussian; the ball's radius is 1."""
    sh_degree: int = 1
    """Degree of the spherical harmonics."""
    pixels: int = 1024
    """Number of pixels compared with the reference; 1000 pixels with 20,000 Gaussians take 2 s."""
    repeats: int = 9
    """Timed steps per setting, interleaved; medians are reported."""
    seed: int = 1
    """Seed of the scene, the sample of pixels and their weights."""

    def __post_init__(self) -> None:
        for name in ("gaussians", "width", "height", "pixels", "repeats"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"RendererReportConfig(): `{name}` must be at least 1, got {getattr(self, name)}; raise it."
                )


@dataclass(frozen=True)
class Setting:
    """One setting of the ladder: the changed option, its value and the whole configuration."""

    knob: str
    value: str
    config: RenderConfig

    @property
    def is_default(self) -> bool:
        """Whether this is the default configuration."""
        return self.config == RenderConfig()


@dataclass(frozen=True)
class ImageError:
    """Error of an image."""

    max: float
    """Largest absolute error."""
    rms: float
    """Root mean square error."""
    psnr: float
    """PSNR, dB."""


@dataclass(frozen=True)
class GradientError:
    """Error of an attribute's gradient."""

    relative_l2: float
    """L2 norm of the error divided by that of the gradient."""
    cosine: float
    """Cosine of the angle between the two gradients."""


@dataclass(frozen=True)
class Errors:
    """Errors of an image and of the gradients by attribute."""

    image: ImageError
    gradients: Mapping[str, GradientError]


@dataclass(frozen=True)
class RendererRow:
    """Errors and times of one setting."""

    knob: str
    """Changed option."""
    value: str
    """Its value."""
    default: bool
    """Whether the value is the default."""
    image: ImageError
    """Error of the image for the exact reference."""
    gradients: Mapping[str, GradientError]
    """Errors of the gradients for the exact reference."""
    rounding: Errors
    """Errors for the reference with the same `alpha_min`."""
    forward_ms: float
    """Median time of rendering, ms."""
    step_ms: float
    """Median time of a whole step, ms."""
    step_ratio: float
    """Median ratio of the step to the default's in the same round."""


@dataclass(frozen=True)
class RendererResult(Record):
    """Results of the renderer's report."""

    scene: Mapping[str, Any]
    """Fields of `RendererReportConfig`."""
    rows: tuple[RendererRow, ...]
    machine: Mapping[str, Any]
    versions: Mapping[str, str]


def ladder() -> list[Setting]:
    """Return the settings, one option changed at a time; each option's values include the default."""
    default, settings = RenderConfig(), []
    for factor, name in ((1 / 64, "1/16320"), (1 / 8, "1/2040"), (1, "1/255"), (4, "4/255"), (16, "16/255")):
        settings.append(Setting("alpha_min", name, replace(default, alpha_min=default.alpha_min * factor)))
    for stop in (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2):
        settings.append(Setting("stop_transmittance", f"{stop:g}", replace(default, stop_transmittance=stop)))
    own = block_shape(default)
    for shape in dict.fromkeys([(4, 2), (4, 4), (8, 2), (8, 4), (8, 8), (16, 4), own]):
        width, height = (None, None) if shape == own else shape
        config = replace(default, block_width=width, block_height=height)
        settings.append(Setting("block", f"{shape[0]}x{shape[1]}", config))
    for flag in (False, True):
        settings.append(Setting("reproducible", str(flag).lower(), replace(default, reproducible=flag)))
    return settings


def report_renderer(
    config: RendererReportConfig, progress: Callable[[str, float, float], None] = lambda *_: None
) -> RendererResult:
    """Measure every setting of the ladder.

    Args:
        config: scene and effort.
        progress: called with (stage, done, total).

    Returns:
        One row per setting, the scene, the machine and the versions.
    """
    gaussians, camera = ball(
        config.seed, config.gaussians, config.width, config.height, config.median_scale, config.sh_degree
    )
    settings = ladder()
    rng = np.random.default_rng(config.seed)
    chosen = rng.choice(config.width * config.height, min(config.pixels, config.width * config.height), replace=False)
    pixels = np.stack([chosen % config.width, chosen // config.width], axis=1)
    weights = rng.normal(size=(len(pixels), 3))

    references: dict[float, tuple[np.ndarray, dict[str, np.ndarray]]] = {}
    cut_offs = dict.fromkeys([_EXACT_ALPHA_MIN, *(setting.config.alpha_min for setting in settings)])
    for done, alpha_min in enumerate(cut_offs):
        progress("Rendering in float64", done, len(cut_offs))
        reference = Reference64(gaussians.numpy(), camera, RenderConfig(alpha_min=alpha_min))
        gradient = np.column_stack([weights, np.zeros(len(weights))])
        references[alpha_min] = reference.render(pixels)[:, :3], reference.gradients(pixels, gradient)
    progress("Rendering in float64", len(cut_offs), len(cut_offs))

    dr.enable_grad(*gaussians.items().values())
    target = np.zeros((config.height, config.width, 3), np.float32)
    target[pixels[:, 1], pixels[:, 0]] = weights
    errors = []
    for done, setting in enumerate(settings):
        progress("Comparing", done, len(settings))
        image, gradients = _rendered(gaussians, camera, setting.config, mi.TensorXf(target))
        found = image[pixels[:, 1], pixels[:, 0]], gradients
        exact, same = references[_EXACT_ALPHA_MIN], references[setting.config.alpha_min]
        errors.append((_errors(found, exact), _errors(found, same)))
    progress("Comparing", len(settings), len(settings))
    times = _times(gaussians, camera, settings, config.repeats, progress)
    rows = (
        RendererRow(s.knob, s.value, s.is_default, exact.image, exact.gradients, rounding, *figures)
        for s, (exact, rounding), figures in zip(settings, errors, times, strict=True)
    )
    return RendererResult(asdict(config), tuple(rows), machine(), versions())


def markdown_table(result: RendererResult) -> str:
    """Return the rows as a table: times, exact errors, and errors of float32 and the early stop alone."""
    titles = ("setting", "forward, ms", "step, ms", "x default", "image RMS", "max", "gradients", "RMS", "gradients")
    rows = []
    for row in result.rows:
        name = f"`{row.knob}` {row.value}"
        cells = [f"**{name}**" if row.default else name]
        cells += [f"{row.forward_ms:.1f}", f"{row.step_ms:.1f}", f"{row.step_ratio:.2f}"]
        cells += [f"{row.image.rms:.1e}", f"{row.image.max:.1e}", f"{worst_gradient(row):.1e}"]
        cells += [f"{row.rounding.image.rms:.1e}", f"{worst_gradient(row.rounding):.1e}"]
        rows.append(cells)
    return markdown(titles, rows, left=len(titles))


def worst_gradient(errors: Errors | RendererRow) -> float:
    """Return the largest relative L2 error of any attribute's gradient."""
    return max(error.relative_l2 for error in errors.gradients.values())


def plot_renderer(result: RendererResult, path: str | Path) -> None:
    """Plot error over run time, one line per option: image and gradients, exact and at the same `alpha_min`.

    Raises:
        ValueError: matplotlib is not installed.
    """
    figure = blank_figure(12, 8.5)
    panels = (
        ("image RMS, against no cut-off at all", lambda row: row.image.rms),
        ("image RMS, against the same alpha_min", lambda row: row.rounding.image.rms),
        ("worst gradient, against no cut-off at all", worst_gradient),
        ("worst gradient, against the same alpha_min", lambda row: worst_gradient(row.rounding)),
    )
    default = next(row for row in result.rows if row.default)
    for axis, (title, error) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for knob in dict.fromkeys(row.knob for row in result.rows):
            rows = [row for row in result.rows if row.knob == knob]
            points = [(row.step_ratio, error(row)) for row in rows]
            axis.plot(*zip(*points, strict=True), _MARKS.get(knob, "o-"), label=knob, alpha=0.8, markersize=5)
            # Labels would overlap if an option has no effect.
            spread = max(y for _, y in points) > 1.5 * min(y for _, y in points)
            named = [(row, point) for row, point in zip(rows, points, strict=True) if spread and not row.default]
            label_points(axis, [point for _, point in named], [row.value for row, _ in named], (5, 3))
        axis.plot(1, error(default), "k*", markersize=13, label="default", zorder=5)
        axis.set(
            title=title,
            xlabel=f"whole step, times the default's {default.step_ms:.0f} ms",
            ylabel="error",
            yscale="log",
        )
        axis.margins(x=0.1)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    save_figure(figure, path)


def _rendered(
    gaussians: Gaussians, camera: Camera, config: RenderConfig, weights: Any
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the image [H, W, 3] and the gradients of <weights, image> by attribute."""
    image = rasterize(gaussians, camera, ("color",), config=config).color
    dr.backward(dr.sum(image * weights, axis=None))
    values = {name: getattr(gaussians, name) for name in ATTRIBUTES}
    gradients = {name: np.array(dr.grad(value), np.float64) for name, value in values.items()}
    for value in values.values():
        dr.clear_grad(value)
    return np.array(dr.detach(image), np.float64), gradients


def _errors(
    found: tuple[np.ndarray, dict[str, np.ndarray]], expected: tuple[np.ndarray, dict[str, np.ndarray]]
) -> Errors:
    """Return the errors of image and gradients."""
    difference = np.abs(found[0] - expected[0])
    rms = float(np.sqrt(np.mean(np.square(difference))))
    image = ImageError(float(difference.max()), rms, -20 * float(np.log10(rms)) if rms > 0 else float("inf"))
    gradients = {}
    for name in ATTRIBUTES:
        a, b = found[1][name].ravel(), expected[1][name].ravel()
        length = np.linalg.norm(b)
        cosine = float(a @ b / (np.linalg.norm(a) * length))
        gradients[name] = GradientError(float(np.linalg.norm(a - b) / length), cosine)
    return Errors(image, gradients)


def _times(
    gaussians: Gaussians,
    camera: Camera,
    settings: Sequence[Setting],
    repeats: int,
    progress: Callable[[str, float, float], None],
) -> list[tuple[float, float, float]]:
    """Return ms forward, ms of a step and its ratio to the default: medians, measured in shuffled rounds."""
    target = mi.TensorXf(np.full((camera.height, camera.width, 3), 0.5, np.float32))

    def forward(config: RenderConfig) -> None:
        with dr.suspend_grad():
            dr.eval(rasterize(gaussians, camera, ("color",), config=config).color)

    def step(config: RenderConfig) -> None:
        image = rasterize(gaussians, camera, ("color",), config=config).color
        dr.backward(dr.mean(dr.abs(image - target), axis=None))
        dr.eval([dr.grad(value) for value in gaussians.items().values()])
        for value in gaussians.items().values():
            dr.clear_grad(value)

    def timed(work: Callable[[RenderConfig], None], config: RenderConfig) -> float:
        dr.sync_thread()
        start = time.perf_counter()
        work(config)
        dr.sync_thread()
        return 1e3 * (time.perf_counter() - start)

    # The default appears once per option and is measured once.
    configs = list(dict.fromkeys(setting.config for setting in settings))
    default = configs.index(RenderConfig())
    for config in configs:  # compiles
        timed(forward, config)
        timed(step, config)
    times = np.zeros((repeats, len(configs), 2))
    rng = np.random.default_rng(0)
    collecting = gc.isenabled()
    gc.disable()  # like `timeit`: a collection would fall on the same setting in every round
    for done in range(repeats):
        progress("Timing", done, repeats)
        for k in rng.permutation(len(configs)):
            times[done, k] = timed(forward, configs[k]), timed(step, configs[k])
        gc.collect()
    if collecting:
        gc.enable()
    progress("Timing", repeats, repeats)
    ratios = np.median(times[:, :, 1] / times[:, default : default + 1, 1], axis=0)
    medians = np.median(times, axis=0)
    rows = [configs.index(setting.config) for setting in settings]
    return [(round(float(medians[k, 0]), 2), round(float(medians[k, 1]), 2), round(float(ratios[k]), 3)) for k in rows]

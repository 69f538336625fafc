"""Error and run time of the renderer's settings: compared with a float64 reference implementation.

    python -m benchmarks.reports renderer --json out.json --plot out.png

One scene, one setting changed at a time. The *exact* image has no cut-offs and no early stop. The
*rounding* error compares with a reference that has the same `alpha_min`: only float32 and the early
stop remain. Errors are measured on a sample of pixels: the loss of the compared gradients has
random weights at these pixels and zero weights elsewhere. So the renderer runs unchanged while the
reference stays affordable.

A row of the JSON has the changed option (`knob`), its `value`, the errors of the `image` (`max`,
`rms`) and of the `gradients` by attribute (`relative_l2`), the same as `rounding`, and the median
time of a whole step in ms, with its median ratio to the default's in the same round.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.reports.plots import blank_figure, label_points, markdown, save_figure
from benchmarks.reports.reference64 import ATTRIBUTES, Reference64
from benchmarks.reports.study import Row
from benchmarks.speed.output import Output
from benchmarks.workloads import ball
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.render.backend import block_shape
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

_MARKS = {"block": "s"}
_SEED = 1  # of the scene, the sample of pixels and their weights
_MEDIAN_SCALE = 0.02  # of the standard deviations; the ball's radius is 1
_SH_DEGREE = 1
_PIXELS = 1024  # compared with the reference; with 20,000 Gaussians they take 2 s
_REPEATS = 9  # timed steps per setting, interleaved; medians are reported
_EXACT_ALPHA_MIN = 1e-12  # smaller values do not change a float32 image
Values = tuple[np.ndarray, dict[str, np.ndarray]]  # of the image, and gradients by attribute


@dataclass(frozen=True)
class Options(Output):
    """Measure error and run time of the renderer's settings, compared with a float64 reference."""

    plot: Path | None = None
    """Plot of error over run time, .png or .svg; needs matplotlib."""
    gaussians: int = 20_000
    """Number of Gaussians, uniform in a ball of radius 1 that fills the view."""
    width: int = 512
    """Width of the image, px."""
    height: int = 384
    """Height of the image, px."""

    def run(self) -> None:
        """Measure every setting, print the table, and write the figures."""
        rows = measure(self)
        print(errors_table(rows))
        if self.plot is not None:
            plot_renderer(rows, self.plot)
        scene = {
            name: value for name, value in asdict(self).items() if name not in ("json", "plot")
        }
        self.write({"scene": scene, "rows": rows}, unprinted=["rows"])


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


def ladder() -> list[Setting]:
    """Return the settings, one option changed at a time; its values include the default."""
    default = RenderConfig()
    settings = []
    for factor, name in ((1 / 64, "1/16320"), (1 / 8, "1/2040"), (1, "1/255"), (4, "4/255")):
        settings.append(
            Setting("alpha_min", name, replace(default, alpha_min=default.alpha_min * factor))
        )
    for stop in (0.0, 1e-5, 1e-4, 1e-3, 1e-2):
        settings.append(
            Setting("stop_transmittance", f"{stop:g}", replace(default, stop_transmittance=stop))
        )
    default_shape = block_shape(default)
    for shape in dict.fromkeys([(4, 4), (8, 4), (8, 8), default_shape]):
        width, height = (None, None) if shape == default_shape else shape
        config = replace(default, block_width=width, block_height=height)
        settings.append(Setting("block", f"{shape[0]}x{shape[1]}", config))
    return settings


def measure(options: Options) -> list[dict[str, Any]]:
    """Return one row for every setting of the ladder."""
    shape = options.width, options.height
    gaussians, camera = ball(_SEED, options.gaussians, *shape, _MEDIAN_SCALE, _SH_DEGREE)
    settings = ladder()
    rng = np.random.default_rng(_SEED)
    count = options.width * options.height
    choice = rng.choice(count, min(_PIXELS, count), replace=False)
    pixels = np.stack([choice % options.width, choice // options.width], axis=1)
    weights = rng.normal(size=(len(pixels), 3))

    references: dict[float, Values] = {}
    for alpha_min in dict.fromkeys(
        [_EXACT_ALPHA_MIN, *(setting.config.alpha_min for setting in settings)]
    ):
        reference = Reference64(gaussians.numpy(), camera, RenderConfig(alpha_min=alpha_min))
        gradient = np.column_stack([weights, np.zeros(len(weights))])
        references[alpha_min] = (
            reference.render(pixels)[:, :3],
            reference.gradients(pixels, gradient),
        )

    dr.enable_grad(*gaussians.items().values())
    target = np.zeros((options.height, options.width, 3), np.float32)
    target[pixels[:, 1], pixels[:, 0]] = weights
    rows = []
    for setting, times in zip(settings, _times(gaussians, camera, settings), strict=True):
        image, gradients = _rendered(gaussians, camera, setting.config, mi.TensorXf(target))
        result = image[pixels[:, 1], pixels[:, 0]], gradients
        exact, same = (
            _errors(result, references[cut]) for cut in (_EXACT_ALPHA_MIN, setting.config.alpha_min)
        )
        keys = {"knob": setting.knob, "value": setting.value, "default": setting.is_default}
        rows.append({**keys, **exact, "rounding": same, **times})
    return rows


def errors_table(rows: Sequence[Row]) -> str:
    """Return time and errors of the settings: of `alpha_min` against no cut-off, of the others
    against the same one.
    """
    lines = []
    for row in rows:
        name = f"`{row['knob']}` {row['value']}"
        errors = row if row["knob"] == "alpha_min" else row["rounding"]
        cells = (
            f"{row['step_ratio']:.2f}",
            f"{errors['image']['rms']:.1e}",
            f"{worst_gradient(errors):.1e}",
        )
        lines.append((f"**{name}**" if row["default"] else name, *cells))
    return markdown(("setting", "time of a step", "error of the image", "of the gradients"), lines)


def worst_gradient(errors: Row) -> float:
    """Return the largest relative L2 error of any attribute's gradient."""
    return max(error["relative_l2"] for error in errors["gradients"].values())


def plot_renderer(rows: Sequence[Row], path: Path) -> None:
    """Plot error over run time, one line per option: image and gradients, exact and at the same
    `alpha_min`.

    Raises:
        ValueError: matplotlib is not installed.
    """
    figure = blank_figure(12, 8.5)
    panels = (
        ("image RMS, against no cut-off at all", lambda row: row["image"]["rms"]),
        ("image RMS, against the same alpha_min", lambda row: row["rounding"]["image"]["rms"]),
        ("worst gradient, against no cut-off at all", worst_gradient),
        ("worst gradient, against the same alpha_min", lambda row: worst_gradient(row["rounding"])),
    )
    default = next(row for row in rows if row["default"])
    for axis, (title, error) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for knob in dict.fromkeys(row["knob"] for row in rows):
            rows_of_knob = [row for row in rows if row["knob"] == knob]
            points = [(row["step_ratio"], error(row)) for row in rows_of_knob]
            axis.plot(
                *zip(*points, strict=True),
                _MARKS.get(knob, "o-"),
                label=knob,
                alpha=0.8,
                markersize=5,
            )
            # Labels would overlap if an option has no effect.
            spread = max(y for _, y in points) > 1.5 * min(y for _, y in points)
            labels = [
                (row, point)
                for row, point in zip(rows_of_knob, points, strict=True)
                if spread and not row["default"]
            ]
            label_points(
                axis, [point for _, point in labels], [row["value"] for row, _ in labels], (5, 3)
            )
        axis.plot(1, error(default), "k*", markersize=13, label="default", zorder=5)
        axis.set(
            title=title,
            xlabel=f"whole step, times the default's {default['step_ms']:.0f} ms",
            ylabel="error",
            yscale="log",
        )
        axis.margins(x=0.1)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    save_figure(figure, path)


def _rendered(gaussians: Gaussians, camera: Camera, config: RenderConfig, weights: Any) -> Values:
    """Return the image [H, W, 3] and the gradients of <weights, image> by attribute."""
    image = rasterize(gaussians, camera, ("color",), config=config).color
    dr.backward(dr.sum(image * weights, axis=None))
    values = {name: getattr(gaussians, name) for name in ATTRIBUTES}
    gradients = {name: np.array(dr.grad(value), np.float64) for name, value in values.items()}
    for value in values.values():
        dr.clear_grad(value)
    return np.array(dr.detach(image), np.float64), gradients


def _errors(result: Values, expected: Values) -> dict[str, Any]:
    """Return the errors of image and gradients."""
    difference = np.abs(result[0] - expected[0])
    rms = float(np.sqrt(np.mean(np.square(difference))))
    gradients = {}
    for name in ATTRIBUTES:
        a = result[1][name].ravel()
        b = expected[1][name].ravel()
        gradients[name] = {"relative_l2": float(np.linalg.norm(a - b) / np.linalg.norm(b))}
    return {"image": {"max": float(difference.max()), "rms": rms}, "gradients": gradients}


def _times(
    gaussians: Gaussians,
    camera: Camera,
    settings: Sequence[Setting],
) -> list[dict[str, float]]:
    """Return ms of a step and its ratio to the default: medians, measured in shuffled rounds."""
    target = mi.TensorXf(np.full((camera.height, camera.width, 3), 0.5, np.float32))

    def step(config: RenderConfig) -> float:
        dr.sync_thread()
        start = time.perf_counter()
        image = rasterize(gaussians, camera, ("color",), config=config).color
        dr.backward(dr.mean(dr.abs(image - target), axis=None))
        dr.eval([dr.grad(value) for value in gaussians.items().values()])
        for value in gaussians.items().values():
            dr.clear_grad(value)
        dr.sync_thread()
        return 1e3 * (time.perf_counter() - start)

    # The default appears once per option and is measured once.
    configs = list(dict.fromkeys(setting.config for setting in settings))
    default = configs.index(RenderConfig())
    for config in configs:  # compiles
        step(config)
    times = np.zeros((_REPEATS, len(configs)))
    rng = np.random.default_rng(0)
    collecting = gc.isenabled()
    gc.disable()  # like `timeit`: a collection would fall on the same setting in every round
    for done in range(_REPEATS):
        for k in rng.permutation(len(configs)):
            times[done, k] = step(configs[k])
        gc.collect()
    if collecting:
        gc.enable()
    ratios = np.median(times / times[:, default : default + 1], axis=0)
    medians = np.median(times, axis=0)
    return [
        {"step_ms": round(float(medians[k]), 3), "step_ratio": round(float(ratios[k]), 3)}
        for k in (configs.index(setting.config) for setting in settings)
    ]

"""Error against run time of the renderer's settings, for Gaussians and cameras of one's own.

Reference implementation of the renderer in double precision, with which its error is measured.

For a list of pixels instead of a whole image: every pixel evaluates every Gaussian, without lists
and early stop. Scenes of any size can be evaluated by a sample. The derivatives are Dr.Jit's.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from io import StringIO
from itertools import product
from math import isqrt
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from morgs_mi.core.attributes import sigmoid
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Arrays, Jit
from morgs_mi.platform.bounded import JsonObject
from morgs_mi.platform.checks import check_number, quantity, require
from morgs_mi.platform.config import config_or_default
from morgs_mi.platform.environment import machine, versions
from morgs_mi.platform.plots import check_plot, label_ends, save_plot
from morgs_mi.platform.progress import Progress, Report
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig

ATTRIBUTES = ("means", "log_scales", "quats", "logit_opacities", "sh_coeffs")
"""Attributes on which the colour depends."""
# Results whose errors are measured: the image, and the gradient of each attribute.
_COMPARED: tuple[str, ...] = ("image", *ATTRIBUTES)
# Those whose gradients may almost vanish: their errors are relative to the largest of the three.
_SHAPE = np.isin(_COMPARED, ("log_scales", "quats", "logit_opacities"))
# Pairs of pixel and Gaussian that are evaluated together: 16 MB per array.
PAIRS = 2_000_000
# Random pixels of a camera that are compared, of which a half chooses. For 100,000 Gaussians the
# reference takes 5 s on two cores.
_PIXELS = 512
ROUNDS = 5
# Times that differ by less are the clock's noise.
_SAME_TIME = 1.05


def reference64(
    gaussians: Gaussians,
    camera: Camera,
    pixels: np.ndarray,
    weights: np.ndarray,
    config: RenderConfig,
) -> tuple[np.ndarray, Arrays]:
    """Return the colours [P, 3] of some pixels over black (eq. 1), display-referred, and the
    gradients of the sum of `weights` times these colours, by attribute in its shape.

    Args:
        gaussians: N Gaussians; their motion and the delays of the camera are ignored.
        camera: the view; its intrinsics are rounded to float32, as in the renderer.
        pixels: columns and rows [P, 2].
        weights: [P, 3].
        config: `eps2d`, `antialiased`, `alpha_min` and `alpha_max` are used.
    """
    types: Any = mi  # The stubs of Mitsuba lack the types of double precision.
    raw = gaussians.numpy()
    # Columns: of rows that are unravelled, Dr.Jit 1.5 loses gradients where the graph remains.
    leaves = {name: types.ArrayXf64(raw[name].reshape(len(gaussians), -1).T) for name in ATTRIBUTES}
    dr.enable_grad(leaves)
    splats, order = _projected(leaves, camera, config)

    N = len(order)
    result = np.zeros(weights.shape)
    count = max(1, PAIRS // max(1, N))
    for start in range(0, len(pixels) if N else 0, count):
        chunk = slice(start, start + count)
        pixel = dr.repeat(types.Array2f64(pixels[chunk].T + 0.5), N)
        splat = dr.gather(_Splats64, splats, mi.UInt32(np.resize(order, dr.width(pixel))))
        offset = pixel - splat.mean
        full = splat.opacity * dr.exp(-0.5 * dr.dot(offset, splat.conic @ offset))
        alpha = dr.select(full >= config.alpha_min, dr.minimum(full, config.alpha_max), 0)
        weight = alpha * dr.exp(dr.block_prefix_sum(dr.log(1 - alpha), N))
        image = dr.block_sum(weight * splat.color, N)
        # The graph of the projection remains for the next pixels.
        loss = dr.sum(dr.dot(image, types.Array3f64(weights[chunk].T)))
        dr.backward(loss, flags=dr.ADFlag.ClearInterior)
        result[chunk] = np.transpose(image)
    return result, {
        name: np.transpose(dr.grad(leaf)).reshape(raw[name].shape) for name, leaf in leaves.items()
    }


@dataclass(frozen=True)
class _Splats64:
    """Gaussians on the screen, in double precision."""

    mean: Jit  # px
    conic: Jit  # inverse of the covariance, 1 / px^2
    opacity: Jit
    color: Jit


def _projected(
    leaves: Mapping[str, Jit], camera: Camera, config: RenderConfig
) -> tuple[_Splats64, np.ndarray]:
    """Return N Gaussians on the screen, and the indices of those in front of the near plane,
    nearest first.

    Args:
        leaves: raw attributes by name, one array per column.
        camera: the view.
        config: `eps2d` and `antialiased` are used.
    """
    types: Any = mi
    means = types.Array3f64(leaves["means"])
    scales = dr.exp(types.Array3f64(leaves["log_scales"]))
    w, *xyz = leaves["quats"]
    quats = types.Quaternion4f64(*xyz, w)
    quats = dr.normalize(dr.select(dr.squared_norm(quats) > 0, quats, 1))
    view = camera.world_to_camera
    R = types.Matrix3f64(view[:3, :3])
    t = types.Array3f64(view[:3, 3])
    point = R @ means + t
    front = point.z >= np.float32(camera.near)
    order = np.argsort(np.where(front, point.z, np.inf), kind="stable")[: np.sum(front)]
    x, y, z = dr.select(front, point, 1)
    axes = R @ dr.quat_to_matrix(types.Matrix3f64, quats) @ dr.diag(scales)

    K = camera.K.astype(np.float32).astype(np.float64)
    f = types.Array2f64(np.diag(K)[:2])
    c = types.Array2f64(K[:2, 2])
    size = types.Array2f64(camera.size)
    tangents = types.Array2f64(x, y) / z
    # Outside of 1.3 times the view, the projection is not linearised.
    clipped = dr.clip(tangents, (-0.15 * size - c) / f, (1.15 * size - c) / f)
    u = f.x / z * (axes[0] - clipped.x * axes[2])
    v = f.y / z * (axes[1] - clipped.y * axes[2])
    covariance = types.Matrix2f64(dr.dot(u, u), dr.dot(u, v), dr.dot(v, u), dr.dot(v, v))
    filtered = covariance + types.Matrix2f64(config.eps2d)
    opacity = sigmoid(leaves["logit_opacities"][0])
    if config.antialiased:
        opacity *= dr.sqrt(dr.det(covariance) / dr.det(filtered))

    sh = [*leaves["sh_coeffs"]]
    color = types.Array3f64(0.5)
    for k, value in enumerate(dr.sh_eval(dr.normalize(means + R.T @ t), isqrt(len(sh) // 3) - 1)):
        color += value * types.Array3f64(sh[3 * k : 3 * k + 3])
    return _Splats64(f * tangents + c, dr.rcp(filtered), opacity, dr.maximum(color, 0)), order


CHANGES = {
    f"1/{levels}, {stop:g}": {"alpha_min": 1 / levels, "stop_transmittance": stop}
    for levels in (255, 4080, 65280)
    for stop in (1e-2, 1e-4, 1e-6)
} | {
    "block 4x4": {"block_width": 4, "block_height": 4},
    "block 8x8": {"block_width": 8, "block_height": 8},
}


@dataclass(frozen=True)
class Setting:
    """Run time and errors of one configuration."""

    name: str  #: Its `alpha_min` and `stop_transmittance`, or another setting.
    config: RenderConfig
    seconds: float  #: Median time of an image and its gradients, mean over the cameras.
    #: Of the image, and of the gradient by attribute; the largest over the cameras.
    errors: Mapping[str, float]
    checked: float  #: Largest error at pixels that take no part in the choice.

    @property
    def error(self) -> float:
        """Largest error."""
        return max(self.errors.values())

    @property
    def gradient_error(self) -> float:
        """Largest error of a gradient."""
        return max(error for name, error in self.errors.items() if name != "image")


@dataclass(frozen=True)
class Accuracy:
    """Errors and run times of the renderer's settings, which a notebook shows (see `accuracy`)."""

    rows: tuple[Setting, ...]
    tolerance: float  #: Largest error of the image and of every gradient.
    num_cameras: int  #: Number of cameras.
    config: RenderConfig | None  #: The chosen one, see `chosen`; None if there is none.
    base: RenderConfig  #: The configuration whose settings are varied.

    @property
    def sentence(self) -> str:
        """The choice in words."""
        where = f"in {quantity(self.num_cameras, 'camera')}"
        for row in self.rows:
            if row.config == self.config:
                return (
                    f"Within {self.tolerance:g} {where}: {row.name}, {1e3 * row.seconds:.1f} ms, "
                    f"largest error {row.error:.0e}."
                )
        best = min(self.rows, key=lambda row: row.error)
        return (
            f"None of the settings is within {self.tolerance:g} {where}: the most exact, "
            f"{best.name}, has an error of {best.error:.0e}."
        )

    def as_dict(self) -> JsonObject:
        """Return the result as JSON can hold it, with machine and versions."""
        return {**asdict(self), "machine": machine(), "versions": versions()}

    def table(self) -> Table:
        """Return a table of at most 80 columns; a star marks `config`."""
        names = (name.split("_")[-1] for name in self.rows[0].errors)
        title = f"relative errors; *: chosen within {self.tolerance:g}"
        table = Table(
            "alpha_min, stop", "ms", *names, box=SIMPLE_HEAD, title=title, padding=(0, 1, 0, 0)
        )
        for row in self.rows:
            name = row.name + " *" * (row.config == self.config)
            errors = (f"{error:.0e}" for error in row.errors.values())
            table.add_row(name, f"{1e3 * row.seconds:.1f}", *errors)
        return table

    def plot(self, path: str | Path, scene: str = "Gaussians") -> None:
        """Plot the errors over run time into a .png, .jpg, .svg or .pdf file.

        Args:
            path: the file.
            scene: name of the scene, for the title.

        Raises:
            ValueError: the suffix is another one, or matplotlib is not installed.
            OSError: the file cannot be written.
        """
        check_plot(Path(path))
        save_plot(Path(path), self._figure(scene), "Accuracy.plot()")

    def _repr_html_(self) -> str:
        plot = StringIO()
        with suppress(ImportError):
            self._figure("Gaussians").savefig(plot, format="svg")
        return self.table()._repr_mimebundle_((), ())["text/html"] + self.sentence + plot.getvalue()

    def _figure(self, scene: str) -> Any:
        from matplotlib.figure import Figure
        from matplotlib.style import context

        figure = Figure((10, 4), layout="constrained")
        with context("tableau-colorblind10"):
            panels = figure.subplots(1, 2)
        seconds = np.array([row.seconds for row in self.rows])
        curves = np.array([row.name.split(",")[0] for row in self.rows])
        base = np.array([row.config == self.base for row in self.rows])
        errors_by_title = {
            "image": np.array([row.errors["image"] for row in self.rows]),
            "worst gradient": np.array([row.gradient_error for row in self.rows]),
        }
        for axes, (title, errors) in zip(panels, errors_by_title.items(), strict=True):
            axes.axhline(self.tolerance, color="0.8", linestyle=":")
            axes.set(xlabel="seconds of an image and its gradients", ylabel="relative error")
            axes.set(yscale="log", title=title)
            ends = []
            for name in dict.fromkeys(curves.tolist()):
                rows = curves == name
                (line,) = axes.plot(seconds[rows], errors[rows], "o-")
                end = (seconds[rows][-1], errors[rows][-1])
                ends.append((name, end, line.get_color()))
            axes.plot(seconds[base], errors[base], "ko", markersize=11, fillstyle="none")
            label_ends(axes, ends)
        figure.suptitle(
            f"{scene}, {quantity(self.num_cameras, 'camera')}, {machine()['processor']}\n"
            "names: alpha_min, along each line stop_transmittance 1e-2, 1e-4 and 1e-6; "
            "ring: as given",
            fontsize="medium",
            parse_math=False,
        )
        return figure


@dataclass(frozen=True, eq=False)
class _Sample:
    """Some pixels of a camera, with the reference's colours and gradients."""

    camera: Camera
    mask: np.ndarray  # of the pixels [H, W]
    weights: mi.TensorXf  # of the loss, [H, W, 3], 0 at other pixels
    expected: Arrays  # colours [P, 3], and gradients by attribute

    @classmethod
    def at(
        cls,
        pixels: np.ndarray,
        gaussians: Gaussians,
        camera: Camera,
        config: RenderConfig,
        rng: np.random.Generator,
    ) -> _Sample:
        """Return the sample of the pixels with these indices [P] in the image."""
        mask = np.zeros((camera.height, camera.width), bool)
        mask.flat[pixels] = True
        weights = np.zeros((*mask.shape, 3))
        weights[mask] = rng.normal(size=(len(pixels), 3))
        places = np.argwhere(mask)[:, ::-1]
        colors, gradients = reference64(gaussians, camera, places, weights[mask], config)
        weights32 = mi.TensorXf(weights.astype(np.float32))
        return cls(camera, mask, weights32, {"image": colors, **gradients})

    def errors(self, image: np.ndarray, gradients: Arrays) -> np.ndarray:
        """Return the relative errors of a rendered image and of its gradients, in the order of
        `_COMPARED`.
        """
        results = {"image": image[self.mask], **gradients}
        expected = self.expected
        differences = [np.linalg.norm(results[name] - expected[name]) for name in _COMPARED]
        norms = np.array([np.linalg.norm(expected[name]) for name in _COMPARED]) + 1e-30
        least = np.where(_SHAPE, 0.01 * norms[_SHAPE].max(), 0)
        return np.array(differences) / np.maximum(norms, least)


def accuracy(
    gaussians: Gaussians,
    cameras: Camera | mi.Sensor | Sequence[Camera | mi.Sensor],
    config: RenderConfig | None = None,
    tolerance: float = 1e-3,
    progress: Report | None = None,
) -> Accuracy:
    """Measure error and run time of the renderer along the settings that trade one for the other.

    `alpha_min`, `stop_transmittance` and the shape of the blocks vary; Gaussians are always sorted
    exactly. Errors are relative L2 norms of the colours of random pixels that show Gaussians, 512
    of each camera, and of gradients, against a float64 reference without both cut-offs; the
    largest over the cameras counts. The loss has random weights at these pixels and zero weights
    elsewhere, so that the renderer runs unchanged. Where the gradient of scales, rotations or
    opacities almost vanishes, its error is relative to a hundredth of the largest of the three.

    The choice (see `chosen`) holds for these Gaussians, these cameras and images of their sizes: in
    a scene in which transmittance falls more slowly, the same settings may be less exact.

    Args:
        gaussians: N Gaussians; their motion is ignored, as are the delays of the cameras.
        cameras: one or several views, or sensors of Mitsuba.
        config: values of the settings that do not vary; default is `RenderConfig()`.
        tolerance: largest error of `Accuracy.config`.
        progress: called with (stage, done, total).

    Returns:
        The settings with their errors and run times, and the chosen one.

    Example:
        >>> result = morgs_mi.accuracy(gaussians, cameras, tolerance=1e-3)
        >>> image = morgs_mi.rasterize(gaussians, cameras[0], config=result.config)

    Raises:
        ValueError: as `rasterize` and `Camera.from_sensor`, a camera sees no Gaussian, or the
            tolerance is not positive.
    """
    check_number("accuracy()", "tolerance", tolerance, "(0, inf)")
    config = replace(config_or_default("accuracy()", config, RenderConfig()), background=None)
    several = cameras if isinstance(cameras, list | tuple) else [cameras]
    views = [replace(Camera.of(view), delay=0, readout=0, background=None) for view in several]
    require(views, "accuracy()", "`cameras` must have a camera", "none", "pass one")
    rng = np.random.default_rng(0)
    # An alpha below 1e-12 changes no float32 image.
    exact = replace(config, alpha_min=1e-12)
    # Of each view two samples: the first chooses, the second takes no part in the choice.
    samples: list[_Sample] = []
    for k, view in enumerate(views):
        alpha = np.array(rasterize(gaussians, view, ("alpha",), config=config).alpha)
        shown = rng.permutation(np.flatnonzero(alpha))[:_PIXELS]
        require(
            len(shown),
            "accuracy()",
            f"`cameras[{k}]` must see Gaussians",
            "none",
            "choose another camera, or one that is nearer",
        )
        # A single pixel serves both.
        for pixels in np.array_split(np.resize(shown, max(2, len(shown))), 2):
            samples.append(_Sample.at(pixels, gaussians, view, exact, rng))
    gaussians = Gaussians(**gaussians.numpy())
    tensors = {name: getattr(gaussians, name) for name in ATTRIBUTES}
    dr.enable_grad(tensors)

    configs = {name: replace(config, **change) for name, change in CHANGES.items()}
    seconds = {name: np.zeros((1 + ROUNDS, len(samples))) for name in configs}
    errors = {name: np.zeros((len(samples), len(_COMPARED))) for name in configs}
    stage = Progress(progress, "Measuring settings")
    # In turns, because other programs may slow down some of them; the first round compiles.
    steps = list(product(range(1 + ROUNDS), configs.items()))
    for done, (k, (name, setting)) in enumerate(steps):
        stage(done, len(steps))
        for i, sample in enumerate(samples):
            dr.sync_thread()
            start = time.perf_counter()
            image = rasterize(gaussians, sample.camera, ("color",), config=setting).color
            dr.backward(dr.sum(image * sample.weights, axis=None))
            gradients: Any = dr.grad(tensors)
            dr.eval(gradients)
            dr.sync_thread()
            seconds[name][k, i] = time.perf_counter() - start
            dr.clear_grad(tensors)
            arrays = {key: np.array(gradient) for key, gradient in gradients.items()}
            errors[name][i] = sample.errors(np.array(image), arrays)
    rows = []
    for name, setting in configs.items():
        largest = errors[name][::2].max(axis=0).tolist()
        checked = float(errors[name][1::2].max())
        time_of_image = float(np.median(seconds[name][1:], axis=0).mean())
        by_name = dict(zip(_COMPARED, largest, strict=True))
        rows.append(Setting(name, setting, time_of_image, by_name, checked))
    choice = chosen(rows, tolerance)
    return Accuracy(tuple(rows), tolerance, len(views), choice and choice.config, config)


def chosen(rows: Sequence[Setting], tolerance: float) -> Setting | None:
    """Return the most exact of the settings that take at most 5 % longer than the fastest within
    the tolerance, at the pixels that choose and at those that do not; None if none is within it.
    """
    precise = [row for row in rows if max(row.error, row.checked) <= tolerance]
    longest = _SAME_TIME * min((row.seconds for row in precise), default=0)
    fast = (row for row in precise if row.seconds <= longest)
    return min(fast, key=lambda row: row.error, default=None)

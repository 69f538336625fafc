"""Time a step through Mitsuba's `mi.render` beside `rasterize`, and several cameras in one call
beside one by one.

    python -m benchmarks.speed.plugin_step --json plugin_step.json

A ball of Gaussians with SH of degree 1. A step is an image, a quadratic loss and the gradients of
all parameters of the shape. Medians of turns in which each kind of step is run once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median
from time import perf_counter
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from benchmarks.workloads import ball
from morgs_mi import Camera, Gaussians, ellipsoids, rasterize

# Number of Gaussians, and width and height of the film.
SIZES = ((500, 256, 192), (20_000, 512, 384), (100_000, 512, 384))
_CAMERAS = 4
_WARM_UP = 2


@dataclass(frozen=True)
class Options(Output):
    """Time a step through `mi.render` and through `rasterize`."""

    turns: int = 15
    """Number of timed turns."""


def milliseconds(works: dict[str, Callable[[], Any]], turns: int) -> dict[str, float]:
    """Return the median time of each work, ms; all works run once in every turn."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(_WARM_UP + turns):
        for name, work in works.items():
            dr.sync_thread()
            start = perf_counter()
            work()
            dr.sync_thread()
            times[name].append(1e3 * (perf_counter() - start))
    return {name: round(median(values[_WARM_UP:]), 2) for name, values in times.items()}


def backward(image: Any, parameters: list[Any]) -> None:
    """Differentiate a quadratic loss of an image, and clear the gradients."""
    dr.backward(dr.mean(dr.square(image), axis=None))
    dr.eval([dr.grad(parameter) for parameter in parameters])
    dr.clear_grad(parameters)


def measure(count: int, width: int, height: int, turns: int) -> dict[str, Any]:
    """Return the times of one size."""
    gaussians, camera = ball(0, count, width, height, 0.4 * count ** (-1 / 3), sh_degree=1)
    shape = ellipsoids(gaussians)
    scene = mi.load_dict(
        {
            "type": "scene",
            "gaussians": shape,
            "sensor": camera.sensor(),
            "integrator": {"type": "gaussian_splat"},
        }
    )
    params = mi.traverse(scene)
    names = ("gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs")
    attributes = list(gaussians.items().values())
    dr.enable_grad(attributes)

    def update() -> None:
        for name in names:
            value: Any = dr.detach(params[name])
            params[name] = mi.Float(value)
            dr.enable_grad(params[name])
        params.update()

    update()
    works = {
        "update": update,
        "plugin": lambda: backward(mi.render(scene, params), [params[name] for name in names]),
        "rasterize": lambda: backward(rasterize(gaussians, camera, ("color",)).color, attributes),
        **camera_works(gaussians, camera, attributes),
    }
    return {"gaussians": count, "width": width, "height": height, **milliseconds(works, turns)}


def camera_works(
    gaussians: Gaussians, camera: Camera, attributes: list[Any]
) -> dict[str, Callable[[], Any]]:
    """Return a step of several cameras in one call, and one of the same cameras one by one."""
    cameras = []
    for v in range(_CAMERAS):
        viewmat = np.array(camera.viewmat)
        viewmat[0, 3] += 0.1 * v
        cameras.append(replace(camera, viewmat=viewmat))

    def one_by_one() -> None:
        for view in cameras:
            backward(rasterize(gaussians, view, ("color",)).color, attributes)

    return {
        "cameras_together": lambda: backward(
            rasterize(gaussians, cameras, ("color",)).color, attributes
        ),
        "cameras_one_by_one": one_by_one,
    }


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    mi.set_variant("llvm_ad_rgb")
    options.write({"rows": [measure(*size, options.turns) for size in SIZES], "seed": 0})


if __name__ == "__main__":
    main()

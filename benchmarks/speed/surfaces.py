"""Time an inserted mesh: splats alone, surfaces alone, both together, and with traced light.

    python -m benchmarks.speed.surfaces --json benchmarks/results/surfaces_speed.json

Scenes are balls of Gaussians with a sphere before their middle, which covers about a quarter of the
view. Times are CPU times of the process on all its threads: on a busy machine they vary less than wall times. The
ratio `together` is the time of both in one image to the sum of the two.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.speed.output import Output
from morgs_mi import Camera, Gaussians, SplatRays, ellipsoids, light_probe, shadow_ratio

CENTER, RADIUS = (0.2, 0.0, -0.9), 0.4
# Gaussians, width and height in px.
SCENES = ((20_000, 800, 600), (100_000, 640, 480), (200_000, 800, 600))


@dataclass(frozen=True)
class Options(Output):
    """Time an inserted mesh."""

    samples: int = 16
    """Samples per pixel of the surfaces."""
    repeats: int = 5
    """Runs of which the median is reported."""
    rays: int = 20_000
    """Rays that are traced through the Gaussians."""


def ball(n: int, seed: int = 0) -> Gaussians:
    """Return n Gaussians in a ball of radius 1, with SH of degree 1."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3))
    means *= rng.uniform(0.2, 1, (n, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    scales, opacities = 0.01 * rng.uniform(0.5, 2, (n, 3)), rng.uniform(0.1, 0.9, n)
    return Gaussians.from_activated(means, scales, rng.normal(size=(n, 4)), opacities, 0.3 * rng.normal(size=(n, 4, 3)))


def seconds(work: Callable[[], Any], repeats: int) -> float:
    """Return the median time of the process during `work`, after two runs of warm-up, s."""
    times = []
    for _ in range(repeats + 2):
        dr.sync_thread()
        start = time.process_time()
        dr.eval(work())
        dr.sync_thread()
        times.append(time.process_time() - start)
    return median(times[2:])


def figures(n: int, width: int, height: int, options: Options) -> dict[str, Any]:
    """Return times in s, and ratios, of one scene."""
    gaussians = ball(n)
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 45, width, height)
    light = light_probe(gaussians, CENTER, near=RADIUS, height=64)
    sphere = {"type": "sphere", "center": list(CENTER), "radius": RADIUS, "bsdf": {"type": "diffuse"}}
    surfaces = {"sphere": sphere, "light": light}

    def image(**entries: Any) -> Callable[[], Any]:
        scene: Any = mi.load_dict({"type": "scene", "sensor": camera.sensor(), **entries})
        return lambda: mi.render(scene, spp=options.samples)

    splats = {"gaussians": ellipsoids(gaussians)}
    both = {**splats, **surfaces}
    inserted: Any = mi.load_dict({"type": "scene", **surfaces})
    works = {
        "splats": image(**splats, integrator={"type": "gaussian_splat"}),
        "surfaces": image(**surfaces, integrator={"type": "path"}),
        "both": image(**both, integrator={"type": "gaussian_splat", "surfaces": {"type": "path"}}),
        "shadow_ratio": lambda: mi.TensorXf(shadow_ratio(gaussians, inserted, camera.position)),
        "tree": lambda: SplatRays(gaussians).transmittance(mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1))),
    }
    times = {name: seconds(work, options.repeats) for name, work in works.items()}
    times |= traced(gaussians, options)
    result = {name: round(value, 4) for name, value in times.items()}
    together = times["both"] / (times["splats"] + times["surfaces"])
    return {"gaussians": n, "width": width, "height": height, **result, "together": round(together, 3)}


def traced(gaussians: Gaussians, options: Options) -> dict[str, float]:
    """Return the time of rays from the middle of the Gaussians into all directions, microseconds per ray."""
    directions = np.random.default_rng(1).normal(size=(3, options.rays))
    directions /= np.linalg.norm(directions, axis=0)
    rays, ray = SplatRays(gaussians), mi.Ray3f(mi.Point3f(*CENTER), mi.Vector3f(np.float32(directions)))
    works = {"transmittance_us": lambda: rays.transmittance(ray), "trace_us": lambda: rays.trace(ray)}
    return {name: 1e6 * seconds(work, options.repeats) / options.rays for name, work in works.items()}


def main(options: Options) -> None:
    """Measure all scenes and write the figures."""
    mi.set_variant("llvm_ad_rgb")
    options.write({"samples": options.samples, "scenes": [figures(*scene, options) for scene in SCENES]})


if __name__ == "__main__":
    main(tyro.cli(Options))

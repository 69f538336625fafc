"""Timing, peak memory and error of one workload, and the baselines."""

from __future__ import annotations

import re
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from benchmarks.reports.reference64 import Reference64
from benchmarks.workloads import TARGET, write_bin
from morgs_mi import Camera, Gaussians, RenderConfig, ellipsoids, rasterize
from morgs_mi.fit.optimise import adam
from morgs_mi.method.losses import recon_loss
from morgs_mi.method.ssim import Target
from morgs_mi.render.blocks import build_lists
from morgs_mi.render.projection import project
from morgs_mi.render.region import Region, full_view

# Pairs of pixel and Gaussian that are computed in float64.
_REFERENCE_PAIRS = 20_000_000
# Mitsuba's integrator traces rays through a hierarchy: beyond this a step takes many seconds.
VOLPRIM_GAUSSIANS = 20_000
VOLPRIM_PIXELS = 512 * 384


def timed(work: Callable[[], Any], repeats: int, patience: float = float("inf")) -> float:
    """Return the median time of `work` in ms, synchronised, after two runs of warm-up.

    If `work` returns a function, only that function is timed. After `patience` seconds, one warm-up
    and one timed run suffice.
    """
    times: list[float] = []
    while len(times) < repeats + 2 and (len(times) < 2 or sum(times) < 1e3 * patience):
        dr.sync_thread()
        start = time.perf_counter()
        result = work()
        if callable(result):
            dr.sync_thread()
            start = time.perf_counter()
            result = result()
        dr.eval(result)
        dr.sync_thread()
        times.append(1e3 * (time.perf_counter() - start))
    return median(times[2:] or times[1:])


def stages(gaussians: Gaussians, camera: Camera, seed: int = 1) -> dict[str, Callable[[], Any]]:
    """Return the timed stages by name.

    Lists (with projection), forward (with lists), adjoint (from the image's gradient to the
    attributes'), the whole step, the step with Adam's, the step on a tenth of the tiles, drawn at
    random, and the L1 + D-SSIM loss with its derivative.
    """
    config = RenderConfig()
    target = np.broadcast_to(np.array(TARGET, np.float32), (camera.height, camera.width, 3)).copy()
    attributes = list(gaussians.items().values())
    full = mi.TensorXf(target)
    dr.enable_grad(attributes)

    def lists() -> Any:
        with dr.suspend_grad():
            region = full_view(camera.width, camera.height, config)
            splats = project(gaussians, camera, ("color",), config)
            block_lists = build_lists(splats, list(splats.channels["color"]), region, config)
        return block_lists.words, block_lists.order

    def forward() -> Any:
        with dr.suspend_grad():
            return rasterize(gaussians, camera, ("color",)).color

    def distance(color: Any, reference: Any = full) -> Any:
        return dr.sum(dr.abs(color - reference), axis=None) / target.size

    def gradients(loss: Any) -> Any:
        dr.backward(loss)
        grads = [dr.grad(value) for value in attributes]
        dr.eval(grads)
        dr.clear_grad(attributes)
        return grads

    def step(region: Region | None = None, reference: Any = full) -> Any:
        return gradients(
            distance(rasterize(gaussians, camera, ("color",), region=region).color, reference)
        )

    def adjoint() -> Callable[[], Any]:
        color = rasterize(gaussians, camera, ("color",)).color
        loss = distance(color)
        dr.eval(color, loss)
        return lambda: gradients(loss)

    tiles = np.random.default_rng(seed).uniform(
        size=(-(-camera.height // 32), -(-camera.width // 32))
    )
    mask = np.kron(tiles <= np.quantile(tiles, 0.1), np.ones((32, 32), bool))[
        : camera.height, : camera.width
    ]

    @cache
    def tenth() -> tuple[Region, Any]:
        region = Region(mask, config)
        return region, mi.TensorXf(region.crop(target))

    @cache
    def optimizer() -> Adam:
        result = adam({name: dr.detach(value) for name, value in gaussians.parameters().items()})
        result.set_learning_rate(1e-9)  # the workload stays as it is
        return result

    def optimised_step() -> Any:
        image = rasterize(gaussians.with_parameters(dict(optimizer().items())), camera, ("color",))
        dr.backward(distance(image.color))
        optimizer().step()
        return list(optimizer().values())

    @cache
    def compared() -> tuple[Any, Target]:
        image = dr.detach(forward())
        dr.enable_grad(image)
        return image, Target(target)

    def loss() -> Any:
        image, reference = compared()
        dr.backward(recon_loss(image, reference))
        grad = dr.grad(image)
        dr.clear_grad(image)
        return grad

    works = {"lists": lists, "forward": forward, "adjoint": adjoint, "step": step}
    return works | {
        "optimised_step": optimised_step,
        "tenth_step": lambda: step(*tenth()),
        "loss": loss,
    }


def measure(
    works: dict[str, Callable[[], Any]], repeats: int, patience: float = float("inf")
) -> dict[str, float]:
    """Return the median ms of every stage."""
    return {name: timed(work, repeats, patience) for name, work in works.items()}


def extent(gaussians: Gaussians, camera: Camera) -> dict[str, float]:
    """Return the number of pairs of Gaussian and block, their pixels in millions, and the bytes of
    the lists.
    """
    config = RenderConfig()
    with dr.suspend_grad():
        region = full_view(camera.width, camera.height, config)
        lists = build_lists(project(gaussians, camera, (), config), [], region, config)
        pairs = int(dr.sum(mi.UInt64(lists.count))[0])
    width, height = region.block
    size = 4 * (dr.width(lists.words) + dr.width(lists.entries))
    return {
        "pairs": pairs,
        "listed_megapixels": round(1e-6 * pairs * width * height, 3),
        "list_bytes": size,
    }


def peak_megabytes(work: Callable[[], Any]) -> float:
    """Return the peak memory of Dr.Jit during `work`, in MB, including the inputs."""
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    dr.eval(work())
    dr.sync_thread()
    return round(1e-6 * dr.detail.malloc_watermark(dr.backend_v(mi.Float)), 1)


def error(gaussians: Gaussians, camera: Camera, seed: int) -> dict[str, float]:
    """Return the largest and the RMS error of the colour at a sample of pixels, compared with
    float64.
    """
    count = max(16, min(256, _REFERENCE_PAIRS // len(gaussians)))
    choice = np.random.default_rng(seed).choice(camera.width * camera.height, count, replace=False)
    pixels = np.stack([choice % camera.width, choice // camera.width], axis=1)
    with dr.suspend_grad():
        image = np.asarray(rasterize(gaussians, camera, ("color",)).color, np.float64)
    reference = Reference64(gaussians.numpy(), camera, RenderConfig()).render(pixels)[:, :3]
    difference = image[pixels[:, 1], pixels[:, 0]] - reference
    figures = {"error_max": np.abs(difference).max(), "error_rms": np.sqrt(np.mean(difference**2))}
    return {name: float(f"{value:.3g}") for name, value in figures.items()}


def volprim_stages(gaussians: Gaussians, camera: Camera) -> dict[str, Callable[[], Any]]:
    """Return forward and whole step of Mitsuba's `volprim_rf_basic` on the same Gaussians, one
    sample per pixel.
    """
    scene: Any = mi.load_dict(
        {
            "type": "scene",
            "gaussians": ellipsoids(gaussians),
            "sensor": camera.sensor(),
            "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
        }
    )
    params = mi.traverse(scene)
    names = [f"gaussians.{name}" for name in ("data", "opacities", "sh_coeffs")]
    dr.enable_grad([params[name] for name in names])
    params.update()

    def forward() -> Any:
        with dr.suspend_grad():
            return mi.render(scene, spp=1)

    def step() -> Any:
        image = mi.render(scene, params, spp=1)[..., :3]
        dr.backward(dr.mean(dr.abs(image - 0.5), axis=None))
        grads = [dr.grad(params[name]) for name in names]
        dr.eval(grads)
        for name in names:
            dr.clear_grad(params[name])
        return grads

    return {"volprim_forward": forward, "volprim_step": step}


def baselines(gaussians: Gaussians, camera: Camera) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the stages of the baselines, and the reasons for which others are omitted."""
    if len(gaussians) > VOLPRIM_GAUSSIANS or camera.width * camera.height > VOLPRIM_PIXELS:
        reason = (
            f"a step beyond {VOLPRIM_GAUSSIANS} Gaussians or {VOLPRIM_PIXELS} pixels takes many "
            "seconds"
        )
        return {}, {"volprim": reason}
    return volprim_stages(gaussians, camera), {}


class Yardstick:
    """External program `BIN FILE.bin REPETITIONS THREADS` that prints the median time of its whole
    step.
    """

    def __init__(self, program: Path) -> None:
        self.program = program.resolve()

    def step(self, gaussians: Gaussians, camera: Camera, repeats: int) -> float:
        """Return the median time of the program's whole step, ms."""
        with tempfile.TemporaryDirectory() as folder:
            workload = Path(folder) / "workload.bin"
            write_bin(gaussians, camera, workload)
            command = [self.program, workload, str(repeats), str(dr.thread_count())]
            output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        match = re.search(r"fwd\+bwd ms: median ([\d.]+)", output)
        if not match:
            raise SystemExit(
                f"{self.program}: expected a line 'fwd+bwd ms: median ...', got {output!r}"
            )
        return float(match[1])

"""Workloads of the speed benchmarks: a workload file, or a ladder of balls of Gaussians.

A workload file is an .npz with `means [N,3]`, `quats [N,4]` wxyz, `scales [N,3]`, `opacities [N]`, `colors [N,3]`,
`K [3,3]`, `viewmat [4,4]`, `width`, `height`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from morgs_mi import Camera, Gaussians
from morgs_mi.core.color_space import SH_C0

TARGET = (0.4, 0.5, 0.6)
EVERY_CHANNEL = ("color", "depth", "motion", "confidence", "alpha")


@dataclass(frozen=True)
class Rung:
    """One ball of the ladder.

    Attributes:
        name: name, unique on the ladder.
        series: series of rungs that vary the same property.
        count: number of Gaussians.
        size: image (width, height) in px.
        scale: median standard deviation of a Gaussian; the ball's radius is 1 and fills the view.
        channels: rendered channels.
        features: number of additional features per Gaussian.
    """

    name: str
    series: str
    count: int = 100_000
    size: tuple[int, int] = (1352, 1014)
    scale: float = 0.01
    channels: tuple[str, ...] = ("color",)
    features: int = 0


_BASE = Rung("100k, 1352x1014", "base")
FULL = (
    Rung("16, 32x24", "overhead", 16, (32, 24), 0.1),
    _BASE,
    *(replace(_BASE, name=f"{n // 1000}k", series="gaussians", count=n) for n in (5_000, 20_000, 50_000, 200_000)),
    replace(_BASE, name="500k", series="gaussians", count=500_000),
    *(replace(_BASE, name=f"{w}x{h}", series="size", size=(w, h)) for w, h in ((320, 240), (676, 507), (2704, 2028))),
    *(replace(_BASE, name=f"scale {s:g}", series="splats", scale=s) for s in (0.002, 0.005, 0.02, 0.05)),
    replace(_BASE, name="2k, screen-filling", series="splats", count=2_000, scale=1.0),
    replace(_BASE, name="confidence", series="channels", channels=("confidence",)),
    replace(_BASE, name="motion", series="channels", channels=("motion",)),
    replace(_BASE, name="color, depth", series="channels", channels=("color", "depth")),
    replace(_BASE, name="color, motion", series="channels", channels=("color", "motion")),
    replace(_BASE, name="every channel", series="channels", channels=EVERY_CHANNEL),
    replace(_BASE, name="every channel, 5 features", series="channels", channels=EVERY_CHANNEL, features=5),
    Rung("500k, 2704x2028", "largest", 500_000, (2704, 2028)),
)
QUICK = (
    Rung("16, 32x24", "overhead", 16, (32, 24), 0.1),
    Rung("5k, 320x240", "size", 5_000, (320, 240), 0.03),
    Rung("20k, 512x384", "size", 20_000, (512, 384), 0.02),
    Rung("20k, 512x384, every channel", "channels", 20_000, (512, 384), 0.02, EVERY_CHANNEL),
    _BASE,
)


def ball(
    seed: int, count: int, width: int, height: int, median_scale: float, sh_degree: int = 0
) -> tuple[Gaussians, Camera]:
    """Return Gaussians uniform in the unit ball, and a camera at distance 3 that sees 50 degrees horizontally."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    means = direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.cbrt(rng.uniform(size=(count, 1)))
    sh = 0.1 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(size=(count, 3)) - 0.5) / SH_C0
    scales = median_scale * np.exp(0.4 * rng.normal(size=(count, 3)))
    quats = rng.normal(size=(count, 4))
    gaussians = Gaussians.from_activated(means, scales, quats, rng.uniform(0.1, 0.95, count), sh)
    return gaussians, Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 50.0, width, height)


def build(rung: Rung, seed: int) -> tuple[Gaussians, Camera]:
    """Return the rung's Gaussians, with motion and confidence if they are rendered, and its camera."""
    gaussians, camera = ball(seed, rung.count, *rung.size, rung.scale)
    rng, extra = np.random.default_rng(seed), {}
    if "motion" in rung.channels:
        extra["motion"] = 0.01 * rng.normal(size=(rung.count, 3))
    if "confidence" in rung.channels:
        extra["logit_confidence"] = rng.normal(size=rung.count)
    return (Gaussians(**gaussians.numpy(), **extra) if extra else gaussians), camera


def load(path: Path) -> tuple[Gaussians, Camera]:
    """Return a workload file's Gaussians, SH degree 0, and its camera."""
    z = np.load(path)
    sh = ((z["colors"] - 0.5) / SH_C0)[:, None, :]
    gaussians = Gaussians.from_activated(z["means"], z["scales"], z["quats"], z["opacities"], sh)
    return gaussians, Camera(z["K"], z["viewmat"].astype(float), int(z["width"]), int(z["height"]))


def write_bin(gaussians: Gaussians, camera: Camera, path: Path) -> None:
    """Write Gaussians of SH degree 0 and their camera in the binary format that `Yardstick` passes on."""
    raw = gaussians.numpy()
    columns = (
        raw["means"],
        raw["quats"] / np.linalg.norm(raw["quats"], axis=1, keepdims=True),
        np.exp(raw["log_scales"]),
        1 / (1 + np.exp(-raw["logit_opacities"])),
        0.5 + SH_C0 * raw["sh_coeffs"][:, 0],
        camera.K,
        camera.viewmat,
    )
    with path.open("wb") as file:
        np.array([len(gaussians), camera.width, camera.height], np.int32).tofile(file)
        for column in columns:
            np.asarray(column, np.float32).tofile(file)
        np.array([*TARGET, 0, 0, 0], np.float32).tofile(file)

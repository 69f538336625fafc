"""Workloads of the speed benchmarks: workload files, and balls of Gaussians.

A workload file is an .npz with `means [N,3]`, `quats [N,4]` wxyz, `scales [N,3]`, `opacities [N]`,
`colors [N,3]`, `K [3,3]`, `viewmat [4,4]`, `width`, `height`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morgs_mi import Camera, Gaussians
from morgs_mi.core.color_space import SH_C0

TARGET = (0.4, 0.5, 0.6)


def ball(
    seed: int, count: int, width: int, height: int, median_scale: float, sh_degree: int = 0
) -> tuple[Gaussians, Camera]:
    """Return Gaussians uniform in the unit ball, and a camera at distance 3 that sees 50 degrees
    horizontally.
    """
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    means = (
        direction
        / np.linalg.norm(direction, axis=1, keepdims=True)
        * np.cbrt(rng.uniform(size=(count, 1)))
    )
    sh = 0.1 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(size=(count, 3)) - 0.5) / SH_C0
    scales = median_scale * np.exp(0.4 * rng.normal(size=(count, 3)))
    quats = rng.normal(size=(count, 4))
    gaussians = Gaussians.from_activated(means, scales, quats, rng.uniform(0.1, 0.95, count), sh)
    return gaussians, Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 50.0, width, height)


def load(path: Path) -> tuple[Gaussians, Camera]:
    """Return a workload file's Gaussians, SH degree 0, and its camera."""
    z = np.load(path)
    sh = ((z["colors"] - 0.5) / SH_C0)[:, None, :]
    gaussians = Gaussians.from_activated(z["means"], z["scales"], z["quats"], z["opacities"], sh)
    return gaussians, Camera(z["K"], z["viewmat"].astype(float), int(z["width"]), int(z["height"]))


def write_bin(gaussians: Gaussians, camera: Camera, path: Path) -> None:
    """Write Gaussians of SH degree 0 and their camera in the binary format that `Yardstick` passes
    on.
    """
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

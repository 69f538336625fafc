"""One optimisation step of peers on the same Gaussians, in turns, and how far their gradients are from ours.

    benchmarks/peers/build.sh FOLDER
    python -m benchmarks.peers.steps --folder FOLDER --json peers.json

A step is forward, L1 loss, adjoint and the gradients of all attributes. The C kernels of ydah/gsplat get Gaussians that
are projected and listed already: their time leaves that out. gsplat's PyTorch path is compared on a small scene alone.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import tyro

from benchmarks.peers.ydah_kernels import Kernels
from benchmarks.speed import timing
from benchmarks.speed.output import Output
from benchmarks.workloads import TARGET, ball
from morgs_mi import Camera, Gaussians, rasterize
from morgs_mi.core.color_space import SH_C0


def published() -> tuple[Gaussians, Camera]:
    """Return the scene of the published figure of ydah/gsplat: grey, faint Gaussians smaller than a pixel."""
    rng, count, size = np.random.default_rng(42), 100_000, 800
    means = rng.random((count, 3)) + np.array([-0.5, -0.5, 2])
    quats = np.broadcast_to([1.0, 0, 0, 0], (count, 4))
    grey = np.full((count, 1, 3), -0.2 / SH_C0)  # not a value of the target: the loss has a kink there
    gaussians = Gaussians.from_activated(means, np.full((count, 3), 0.03), quats, np.full(count, 0.2), grey)
    K = np.array([[52.0, 0, size / 2], [0, 52, size / 2], [0, 0, 1]])
    return gaussians, Camera(K, np.eye(4), size, size)


SCENES: dict[str, Callable[[], tuple[Gaussians, Camera]]] = {
    "20,000 Gaussians, 512x384": lambda: ball(1, 20_000, 512, 384, 0.02),
    "100,000 Gaussians, 800x800": lambda: ball(1, 100_000, 800, 800, 0.012),
    "ydah/gsplat's own, 100,000, 800x800": published,
}
SMALL = (300, 96, 72, 0.08)


@dataclass(frozen=True)
class Options(Output):
    """Peers and output."""

    folder: Path = Path("peers")
    """Folder in which `build.sh` has built them."""
    rounds: int = 3
    """Rounds in which all run in turn."""
    repeats: int = 5
    """Timed repetitions in a round."""


def figures(name: str, options: Options) -> dict[str, Any]:
    """Return the median ms of a step of each program, and the differences of image and gradients."""
    gaussians, camera = SCENES[name]()
    library = options.folder / "kernels" / "ydah.so"
    with dr.suspend_grad():
        kernels = Kernels.of(library, gaussians, camera)
    works: dict[str, Callable[[], Any]] = {"ours": timing.stages(gaussians, camera)["step"]}
    works["ydah kernels"] = lambda: kernels.step(np.array(TARGET, np.float32)) and None
    if len(gaussians) <= timing.VOLPRIM_GAUSSIANS:
        works["volprim_rf_basic"] = timing.volprim_stages(gaussians, camera)["volprim_step"]
    rounds = [timing.measure(works, options.repeats, patience=2.0) for _ in range(options.rounds)]
    found = {program: round(median(row[program] for row in rounds), 2) for program in works}
    image, grads = ours(gaussians, camera, np.broadcast_to(TARGET, (camera.height, camera.width, 3)))
    theirs = kernels.step(np.array(TARGET, np.float32))
    own = {"opacities": grads["opacities"], "colors": grads["colors"]}
    pictures = np.abs(kernels.arrays["image"].reshape(image.shape) - image).max()
    return {"ms": found, "image": float(pictures), "gradients": relative(own, theirs)}


def ours(gaussians: Gaussians, camera: Camera, target: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return our image and gradients of the mean L1 distance, with respect to activated attributes."""
    attributes = gaussians.items()
    dr.enable_grad(list(attributes.values()))
    color = rasterize(gaussians, camera, ("color",)).color
    dr.backward(dr.mean(dr.abs(color - mi.TensorXf(np.ascontiguousarray(target, np.float32))), axis=None))
    grads = {name: np.array(dr.grad(value)) for name, value in attributes.items()}
    dr.clear_grad(list(attributes.values()))
    opacities, scales = np.asarray(dr.detach(gaussians.opacities)), np.asarray(dr.detach(gaussians.scales))
    activated = {
        "means": grads["means"],
        "quats": grads["quats"],
        "scales": grads["log_scales"] / scales,
        "opacities": grads["logit_opacities"] / (opacities * (1 - opacities)),
        "colors": grads["sh_coeffs"][:, 0] / SH_C0,
    }
    return np.array(dr.detach(color)), activated


def relative(found: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the norm of the difference of each gradient, relative to the norm of the gradient."""
    return {
        name: float(np.linalg.norm(value - other[name].reshape(value.shape)) / np.linalg.norm(value))
        for name, value in found.items()
    }


def pytorch(options: Options) -> dict[str, Any]:
    """Return ms of gsplat's PyTorch path on the small scene, and the differences of image and gradients from ours."""
    gaussians, camera = ball(2, *SMALL)
    raw = gaussians.numpy()
    target = np.broadcast_to(np.array(TARGET, np.float32), (camera.height, camera.width, 3))
    scene = {
        "means": raw["means"],
        "quats": raw["quats"],
        "scales": np.exp(raw["log_scales"]),
        "opacities": 1 / (1 + np.exp(-raw["logit_opacities"])),
        "colors": 0.5 + SH_C0 * raw["sh_coeffs"][:, 0],
        **{"K": camera.K, "viewmat": camera.viewmat, "width": camera.width, "height": camera.height, "target": target},
    }
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder) / "scene.npz", Path(folder) / "found.npz"
        np.savez(given, **scene)
        python, script = options.folder / "torch" / "bin" / "python", Path(__file__).parent / "pytorch_path.py"
        subprocess.run([python, script, given, result], check=True)
        with np.load(result) as file:
            found = dict(file)
    image, grads = ours(gaussians, camera, target)
    theirs = {name: found[f"grad_{name}"] for name in grads}
    step = timing.timed(timing.stages(gaussians, camera)["step"], options.repeats)
    return {
        "ms": {"ours": round(step, 2), "gsplat, PyTorch": round(float(found["ms"]), 2)},
        "image": float(np.abs(found["image"] - image).max()),
        "gradients": relative(grads, theirs),
        "torch": str(found["version"]),
    }


def main(options: Options) -> None:
    """Run the benchmark."""
    mi.set_variant("llvm_ad_rgb")
    rows = {name: figures(name, options) for name in SCENES}
    options.write({"threads": dr.thread_count(), "scenes": rows, "small": pytorch(options)})


if __name__ == "__main__":
    main(tyro.cli(Options))

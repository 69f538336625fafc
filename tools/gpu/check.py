"""Images and gradients of fixed scenes, to compare between variants and machines.

    python tools/gpu/check.py VARIANT OUT.npz [REFERENCE.npz]

The reference is the file that another variant or machine wrote.
"""

from __future__ import annotations

import sys

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi import Camera, Gaussians, rasterize

SCENES = {"few": (12, 70, 45), "some": (2_000, 160, 120), "many": (30_000, 512, 384)}
CHANNELS = ("color", "alpha", "depth")


def images_and_gradients(count: int, width: int, height: int) -> dict[str, np.ndarray]:
    """Return the channels and the gradients of a random scene, by name."""
    rng = np.random.default_rng(count)
    gaussians = Gaussians.from_activated(
        means=rng.uniform(-1, 1, (count, 3)),
        scales=2 * (12 / count) ** (1 / 3) * rng.uniform(0.01, 0.15, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        opacities=rng.uniform(0.1, 0.95, count),
        sh_coeffs=0.4 * rng.normal(size=(count, 4, 3)),
    )
    camera = Camera.look_at((0.3, -4, 1), (0, 0, 0), (0, 0, 1), 40, width, height)
    attributes = gaussians.items()
    dr.enable_grad(*attributes.values())
    image = rasterize(gaussians, camera, CHANNELS)
    weight = np.random.default_rng(1).normal(size=(height, width, 3)).astype(np.float32)
    dr.backward(dr.sum(image.color * mi.TensorXf(weight), axis=None))
    channels = {name: np.array(image[name]) for name in CHANNELS}
    gradients = {f"d{name}": np.array(dr.grad(value)) for name, value in attributes.items()}
    return channels | gradients


def main(variant: str, out: str, reference: str | None = None) -> None:
    """Write the results of all scenes; print their differences to a file of another variant."""
    mi.set_variant(variant)
    results = {
        f"{scene}.{name}": value
        for scene, size in SCENES.items()
        for name, value in images_and_gradients(*size).items()
    }
    np.savez_compressed(out, allow_pickle=False, **results)
    if reference is None:
        return
    for name, expected in np.load(reference).items():
        largest = float(np.abs(expected).max()) or 1.0
        difference = float(np.abs(results[name] - expected).max()) / largest
        print(f"{name:22s} largest {largest:9.3g}, difference over largest {difference:.1e}")


if __name__ == "__main__":
    main(*sys.argv[1:])

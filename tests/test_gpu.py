"""CUDA against LLVM: the same kernels on both backends. Run with `pytest -m gpu`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import rasterize
from tests import tolerances as tol
from tests.assertions import assert_close
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import CHANNELS, RAW, make_scene, make_unit_scene, to_gaussians
from tests.scenes.plugin import AOVS, make_mitsuba_scene

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not dr.has_backend(dr.JitBackend.CUDA), reason="needs an NVIDIA GPU"),
]


def on(variant, function):
    """Return the arrays by name that `function` returns with this variant."""
    mi.set_variant(variant)
    return {name: np.array(value, np.float64) for name, value in function().items()}


def assert_variants_agree(function):
    cpu, gpu = on("llvm_ad_rgb", function), on("cuda_ad_rgb", function)
    assert cpu.keys() == gpu.keys()
    for name in cpu:
        assert np.isfinite(gpu[name]).all(), name
        assert_close(gpu[name], cpu[name], rtol=tol.GRADIENT_REL, name=name)


@pytest.mark.parametrize("n", [10, 300])
def test_rasterize__agrees_between_cuda_and_llvm(n):
    camera = make_camera(70, 45)
    raw = make_scene(n=n)
    weight = np.float32(np.random.default_rng(1).normal(size=(45, 70, 3)))

    def run():
        gaussians = to_gaussians(raw, grad=True)
        image = rasterize(gaussians, camera, CHANNELS)
        solid = np.asarray(image.alpha) > 0.02  # elsewhere normalised channels divide by a small alpha
        images = {name: np.asarray(dr.detach(image[name])) * solid for name in CHANNELS}
        dr.backward(dr.sum(image.color * mi.TensorXf(weight), axis=None) + dr.sum(image.confidence, axis=None))
        return images | {f"gradient of {name}": dr.grad(getattr(gaussians, name)) for name in RAW}

    assert_variants_agree(run)


def test_gaussian_splat__agrees_between_cuda_and_llvm():
    raw = make_unit_scene()

    def run():
        scene = make_mitsuba_scene(
            to_gaussians(raw), {"pixel_format": "rgba", "rfilter": {"type": "gaussian"}}, aovs=AOVS
        )
        params = mi.traverse(scene)
        names = [f"gaussians.{name}" for name in ("data", "opacities", "sh_coeffs")]
        dr.enable_grad([params[name] for name in names])
        image = mi.render(scene, params)
        dr.backward(dr.sum(dr.square(image[..., :4]), axis=None))
        return {"image": dr.detach(image)[..., :4]} | {f"gradient of {name}": dr.grad(params[name]) for name in names}

    assert_variants_agree(run)


def test_gaussian_splat__survives_switching_variants():
    raw = make_unit_scene()
    images = [
        on(variant, lambda: {"image": mi.render(make_mitsuba_scene(to_gaussians(raw)))})["image"]
        for variant in ("cuda_ad_rgb", "llvm_ad_rgb", "cuda_ad_rgb")
    ]
    np.testing.assert_array_equal(images[0], images[2])
    assert_close(images[0], images[1], atol=tol.IMAGE_ABS)

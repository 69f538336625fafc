"""CUDA against LLVM: the same kernels on both backends. Run with `pytest -m gpu`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import Gaussians, StreamLoop, rasterize
from morgs_mi.core.arrays import from_numpy
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.objective import flow_loss, mask_loss, recon_loss
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests import tolerances as tol
from tests.quick import NO_DENSITY, quick
from tests.scenes import surfaces
from tests.scenes.ball import images_of, mean_psnr, opaque_ball, views
from tests.scenes.cameras import make_camera, make_wide_camera
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import (
    CHANNELS,
    RAW,
    make_scene,
    make_unit_scene,
    make_wide_scene,
    to_gaussians,
)
from tests.scenes.plugin import AOVS, make_mitsuba_scene

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not dr.has_backend(dr.JitBackend.CUDA), reason="needs an NVIDIA GPU"),
]


def on(variant, function):
    """Return the arrays by name that `function` returns with this variant."""
    mi.set_variant(variant)
    return {name: np.array(value, np.float64) for name, value in function().items()}


def assert_variants_agree(function, rtol=tol.GRADIENT_REL):
    cpu = on("llvm_ad_rgb", function)
    gpu = on("cuda_ad_rgb", function)
    assert cpu.keys() == gpu.keys()
    for name in cpu:
        assert np.isfinite(gpu[name]).all(), name
        assert_close(gpu[name], cpu[name], rtol=rtol, name=name)


@pytest.mark.parametrize("n", [10, 300])
def test_rasterize__agrees_between_cuda_and_llvm(n):
    camera = make_camera(70, 45)
    raw = make_scene(n=n)
    weight = np.float32(np.random.default_rng(1).normal(size=(45, 70, 3)))

    def run():
        gaussians = to_gaussians(raw, grad=True)
        image = rasterize(gaussians, camera, CHANNELS)
        # Elsewhere normalised channels divide by a small alpha.
        solid = np.asarray(image.alpha) > 0.02
        images = {name: np.asarray(dr.detach(image[name])) * solid for name in CHANNELS}
        dr.backward(
            dr.sum(image.color * mi.TensorXf(weight), axis=None)
            + dr.sum(image.confidence, axis=None)
        )
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
        backward(dr.square(image[..., :4]))
        return {"image": dr.detach(image)[..., :4]} | {
            f"gradient of {name}": dr.grad(params[name]) for name in names
        }

    assert_variants_agree(run)


def test_gaussian_splat__survives_switching_variants():
    raw = make_unit_scene()
    images = [
        on(variant, lambda: {"image": mi.render(make_mitsuba_scene(to_gaussians(raw)))})["image"]
        for variant in ("cuda_ad_rgb", "llvm_ad_rgb", "cuda_ad_rgb")
    ]
    assert_array_equal(images[0], images[2])
    assert_close(images[0], images[1], atol=tol.IMAGE_ABS)


@pytest.mark.parametrize("masked", [False, True])
def test_losses__agree_between_cuda_and_llvm(masked):
    rng = np.random.default_rng(0)
    target = rng.uniform(0, 1, (37, 45, 3)).astype(np.float32)
    image = (target + rng.normal(0, 0.2, target.shape)).astype(np.float32)
    flow, drawn = rng.normal(size=(2, 37, 45, 2)).astype(np.float32)
    mask = rng.random((37, 45)) > 0.4
    pixels = mask.size

    def run():
        observations = {
            "recon": from_numpy(mi.TensorXf, image),
            "flow": from_numpy(mi.TensorXf, drawn),
        }
        observations["mask"] = from_numpy(mi.TensorXf, image[..., :1].copy())
        dr.enable_grad(list(observations.values()))
        reliable = from_numpy(mi.TensorXf, mask.astype(np.float32))
        losses = {
            "recon": recon_loss(
                observations["recon"], Target(target, mask if masked else None), 0.2
            ),
            "flow": flow_loss(
                observations["flow"], from_numpy(mi.TensorXf, flow), reliable, 1 / pixels
            ),
            "mask": mask_loss(observations["mask"], reliable, 1 / pixels),
        }
        dr.backward(sum(losses.values()))
        gradients = {f"gradient of {name}": dr.grad(value) for name, value in observations.items()}
        return {name: dr.detach(value) for name, value in losses.items()} | gradients

    assert_variants_agree(run, rtol=tol.LOSS_GRADIENT_REL)


def test_rasterize__agrees_between_cuda_and_llvm_on_a_region():
    camera = make_wide_camera()
    raw = make_wide_scene()
    y, x = np.mgrid[: camera.height, : camera.width]
    mask = np.float32((x - 30) ** 2 + (y - 20) ** 2 < 12**2)[..., None]

    def run():
        gaussians = Gaussians(**raw)
        region = Region.of(mask[..., 0] > 0)
        dr.enable_grad(*gaussians.items().values())
        image = render_view(gaussians, ActiveView(camera, region=region), CHANNELS)
        # Blocks have another shape on CUDA and thus reach further beyond the mask.
        weight = mi.TensorXf(region.crop(mask))
        color = image.color * weight
        confidence = image.confidence * weight
        dr.backward(dr.sum(dr.square(color), axis=None) + dr.sum(confidence, axis=None))
        image_color = region.uncropped(np.array(dr.detach(color)))
        colors = {"color": image_color[: mask.shape[0], : mask.shape[1]]}
        return colors | {f"gradient of {name}": dr.grad(getattr(gaussians, name)) for name in RAW}

    assert_variants_agree(run)


def test_gaussian_splat__agrees_between_cuda_and_llvm_among_surfaces():
    def run():
        lit = {"wall": surfaces.wall(-0.2), "lamp": surfaces.LAMP}
        return {"image": surfaces.render(surfaces.scene(surfaces.cloud(0.3), **lit), seed=1)}

    # Rays of the path tracer that just miss an edge on one backend may hit it on the other.
    cpu = on("llvm_ad_rgb", run)["image"]
    gpu = on("cuda_ad_rgb", run)["image"]
    assert np.median(np.abs(gpu - cpu)) < tol.IMAGE_ABS
    assert np.abs(gpu - cpu).mean() < 1e-3


def test_stream_loop__fits_two_frames_alike_on_cuda_and_llvm():
    """Steps amplify the rounding of sums, so the quality of the fits is compared."""
    changes = {"num_gaussians": 400, "first_frame_steps": 150, "confidence_steps": 20, "epochs": 4}
    config = quick(MotionConfig(key_views=2), dropout=0.0, density=NO_DENSITY, **changes)

    def run():
        ball = opaque_ball()
        shift = np.array([0.06, -0.03, 0.02], np.float32)
        frames = [
            images_of(ball),
            images_of(Gaussians(**{**ball.numpy(), "means": ball.numpy()["means"] + shift})),
        ]
        loop = StreamLoop(views(), ball.numpy()["means"], np.full((400, 3), 0.5), config)
        scores = []
        for images in frames:
            loop.push([np.uint8(255 * image + 0.5) for image in images])
            scores.append(mean_psnr(loop.gaussians, images))
        return {"psnr": scores}

    cpu = on("llvm_ad_rgb", run)["psnr"]
    gpu = on("cuda_ad_rgb", run)["psnr"]
    assert_close(gpu, cpu, atol=0.2)
    assert cpu.min() > 22

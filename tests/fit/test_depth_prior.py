"""Depth of single images as a prior: network, alignment, and its effect on the first frame."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from onnx import helper

from morgs_mi import RenderConfig, rasterize
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.depth_prior import DepthNetwork, depth_prior, fit_line, fit_line_robustly
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.losses.ssim import Target
from morgs_mi.render.active_view import ActiveView
from tests.assertions import assert_close
from tests.scenes.ball import ball, images_of, opaque_ball, views
from tests.scenes.cameras import look_at_cameras
from tests.scenes.tiny_network import write

MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
# Weights of red, green and blue of the network's output.
WEIGHTS = np.array([0.5, 0.2, -0.1])


def export(path, height="h", width="w", channels=1, squeezed=True, inputs=1):
    """Write a network whose inverse depth is a sum of the image's own colours, as [1, H, W] or [1, 1, H, W]."""
    # Of normalised colours, the sum of the colours themselves.
    constants = {
        "color": np.repeat((WEIGHTS * DEVIATION).astype(np.float32)[None, :, None, None], channels, axis=0),
        "bias": np.full(channels, WEIGHTS @ MEAN, np.float32),
        "axis": np.array([1]),
    }
    nodes = [helper.make_node("Conv", ["image0", "color", "bias"], ["map" if squeezed else "depth"])]
    if squeezed:
        nodes.append(helper.make_node("Squeeze", ["map", "axis"], ["depth"]))
    else:
        del constants["axis"]
    outputs = {"depth": (1, None, None) if squeezed else (1, channels, None, None)}
    return write(path, nodes, {f"image{k}": (1, 3, height, width) for k in range(inputs)}, outputs, constants)


def ramp(height, width):
    """Return an image whose colours vary linearly, which resizing does not change away from the border."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    return np.stack([x, y, (x + y) / 2], axis=-1)


@pytest.mark.parametrize("squeezed", [True, False])
@pytest.mark.parametrize("size", [("h", "w"), (28, 56)])
def test_depth_network__returns_the_known_inverse_depth(tmp_path, size, squeezed):
    image = ramp(45, 80)
    found = DepthNetwork(export(tmp_path / "tiny.onnx", *size, squeezed=squeezed))(image)
    assert found.shape == (45, 80)
    assert found.dtype == np.float32
    assert_close(found[4:-4, 4:-4], (image @ WEIGHTS)[4:-4, 4:-4], atol=0.01)


def test_depth_network__of_open_size_gets_sides_that_are_multiples_of_14(tmp_path, monkeypatch):
    sizes = []

    def record(image, width, height):
        sizes.append((width, height))
        return np.zeros((1, 3, height, width), np.float32)

    monkeypatch.setattr("morgs_mi.fit.depth_prior.imagenet_blob", record)
    DepthNetwork(export(tmp_path / "tiny.onnx"))(ramp(45, 80))
    assert sizes == [(924, 518)]


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"inputs": 2}, r"one image \[1, 3, H, W\] as its input, got \[1, 3, \?, \?\] and"),
        ({"channels": 2, "squeezed": False}, r"output \[1, 28, 56\], the inverse depth, got \[1, 2, 28, 56\]"),
    ],
)
def test_depth_network__rejects_another_signature(tmp_path, made, message):
    size = () if made.get("inputs") else (28, 56)
    with pytest.raises(ValueError, match=message):
        DepthNetwork(export(tmp_path / "tiny.onnx", *size, **made))(ramp(45, 80))


def test_depth_network__rejects_a_file_that_is_no_network(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.onnx: expected an ONNX file, found none"):
        DepthNetwork(tmp_path / "missing.onnx")
    path = tmp_path / "text.onnx"
    path.write_bytes(b"not a network, but long enough to look like one")
    with pytest.raises(ValueError, match=r"text\.onnx: expected an ONNX file, got another format"):
        DepthNetwork(path)


def test_fit_line__agrees_with_weighted_least_squares_in_float64():
    rng = np.random.default_rng(0)
    x, y, weights = rng.normal(1e3, 1, 50), rng.normal(0, 2, 50), rng.uniform(0, 1, 50)
    columns, root = np.stack([x, np.ones(50)], axis=1), np.sqrt(weights)
    expected = np.linalg.lstsq(columns * root[:, None], y * root, rcond=None)[0]
    assert fit_line(x, y, weights) == pytest.approx(expected, rel=1e-9)


def test_fit_line_robustly__ignores_outliers():
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 5, 200)
    y = 0.3 * x + 0.7
    y[:60] = rng.uniform(0, 0.5, 60)  # points that another surface hides
    assert fit_line_robustly(x, y) == pytest.approx((0.3, 0.7), abs=1e-4)
    assert abs(fit_line(x, y, np.ones(200))[0] - 0.3) > 0.05


def depth_maps(cameras):
    """Return the inverse depth of the opaque ball in views, each with a scale and a shift of its own."""
    maps = []
    for k, camera in enumerate(cameras):
        image = rasterize(opaque_ball(), camera, ("depth", "alpha"))
        depth, alpha = (np.asarray(image[name])[..., 0] for name in ("depth", "alpha"))
        maps.append(np.where(alpha > 0.5, (2 + k) / np.maximum(depth, 1e-3) + 0.5 * k, np.nan))
    return maps


def surface_points(cameras):
    """Return a point on the ball's rendered surface for every fourth pixel of the views."""
    found = []
    for camera, relative in zip(cameras, depth_maps(cameras), strict=True):
        depth = np.asarray(rasterize(opaque_ball(), camera, ("depth",)).depth)[..., 0]
        rows, columns = (each[::4] for each in np.nonzero(np.isfinite(relative)))
        found.append(camera.unproject(np.stack([columns, rows], axis=-1) + 0.5, depth[rows, columns]))
    return np.concatenate(found)


def inverse_depth(camera):
    return 1 / np.maximum(np.asarray(rasterize(opaque_ball(), camera, ("depth",)).depth)[..., 0], 1e-3)


def check_aligned(prior):
    for camera, aligned in zip(views(), prior.aligned, strict=True):
        known = np.asarray(aligned.known) > 0
        assert known.mean() > 0.9
        assert_close(np.asarray(aligned.inverse)[known], inverse_depth(camera)[known], rtol=0.02)


def test_depth_prior__is_aligned_to_points():
    cameras = views()
    check_aligned(depth_prior(depth_maps(cameras), cameras, surface_points(cameras)))


def test_depth_prior__without_points_is_aligned_to_the_fit():
    cameras = views()
    prior = depth_prior(depth_maps(cameras), cameras, np.zeros((0, 3)))
    assert prior.aligned == (None,) * 4
    check_aligned(prior.completed(opaque_ball(), [ActiveView(camera) for camera in cameras]))


def test_depth_prior__leaves_masked_pixels_out():
    cameras = views()
    masks = [None, *(np.arange(48)[:, None] < np.full(64, 24) for _ in range(3))]
    prior = depth_prior(depth_maps(cameras), cameras, surface_points(cameras), masks)
    assert np.asarray(prior.aligned[0].known)[24:].any()
    assert not np.asarray(prior.aligned[1].known)[24:].any()


def test_depth_prior__that_contradicts_the_points_is_not_used():
    cameras = views()
    prior = depth_prior([-relative for relative in depth_maps(cameras)], cameras, surface_points(cameras))
    assert prior.aligned == (None,) * 4


CONFIG = FitConfig(sh_degree=0, num_gaussians=200, first_frame_steps=80)


def fitted(prior, config=CONFIG, start=None):
    targets = [Target(image) for image in images_of(opaque_ball())]
    render = RenderConfig(reproducible=True)
    rng = np.random.default_rng(0)
    return fit_first_frame(start or ball(100), views(), targets, 3.0, config, render, rng, prior=prior)


def held_out_psnr(gaussians):
    """Return the mean PSNR of views between and beside the training views, dB."""
    cameras = look_at_cameras([(0, 0, -3.5), (1.6, 0, -3.2), (-1.6, 0, -3.2), (0, 1.2, -3.3)], 40)
    shown = ([np.asarray(rasterize(each, c).color) for c in cameras] for each in (gaussians, opaque_ball()))
    return float(np.mean([psnr(*pair) for pair in zip(*shown, strict=True)]))


@pytest.fixture(scope="module")
def unguided():
    return fitted(None).gaussians


@pytest.mark.parametrize("with_points", [True, False])
def test_fit_first_frame__has_better_held_out_views_with_depth(unguided, with_points):
    cameras = views()
    prior = depth_prior(depth_maps(cameras), cameras, surface_points(cameras)[:: 1 if with_points else 10**6])
    guided = fitted(prior)
    print(held_out_psnr(unguided), held_out_psnr(guided.gaussians))
    assert held_out_psnr(guided.gaussians) > held_out_psnr(unguided) + 0.2
    assert {*guided.losses} == {"recon", "depth"}


def test_fit_first_frame__without_weight_is_the_same_to_the_bit(monkeypatch):
    cameras, rendered = views(), []
    prior = depth_prior(depth_maps(cameras), cameras, surface_points(cameras))
    config = dataclasses.replace(CONFIG, first_frame_steps=12)
    plain = fitted(None, config)
    render = ActiveView.render

    def record(view, gaussians, channels=("color",), *rest):
        rendered.append(channels)
        return render(view, gaussians, channels, *rest)

    monkeypatch.setattr(ActiveView, "render", record)
    off = fitted(prior, dataclasses.replace(config, depth_weight=0.0))
    assert np.array_equal(np.asarray(plain.gaussians.means), np.asarray(off.gaussians.means))
    assert set(rendered) == {("color",)}
    assert {*off.losses} == {"recon"}


def test_fit_config__rejects_a_negative_depth_weight():
    with pytest.raises(ValueError, match="`depth_weight` must be finite and not negative, got -1"):
        FitConfig(depth_weight=-1.0)

"""Depth of single images as a prior: network, alignment, and its effect on the first frame."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from onnx import helper

from morgs_mi import RenderConfig, StreamConfig, StreamLoop, rasterize
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.agreement import compare_fits
from morgs_mi.fit.config import CrossValidationConfig, FitConfig
from morgs_mi.fit.cross_validation import cross_validate
from morgs_mi.fit.depth_prior import DepthNetwork, depth_prior, fit_line, fit_line_robustly
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.initialise import from_points
from morgs_mi.fit.view import View
from morgs_mi.losses.ssim import Target
from morgs_mi.render.active_view import ActiveView
from tests.assertions import assert_close
from tests.scenes.cameras import QUAD, look_at_cameras
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


VIEWS = look_at_cameras(QUAD[:3])
HELD_OUT = look_at_cameras([(0, 0, -3.5), (1.5, 0, -3.3), (-1.5, 0, -3.3), (0, 1.1, -3.4)])


def card(camera):
    """Return the image [H, W, 3] of a plain card in front of a wall of smooth colours, and its points [H, W, 3]."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    origin, rays = camera.rays(np.stack([x, y], axis=-1))
    near, far = (origin + rays * ((z - origin[2]) / rays[..., 2:]) for z in (-0.6, 0.8))
    on_card = (np.abs(near[..., :2]) < 0.5).all(axis=-1, keepdims=True)
    wall = 0.5 + 0.2 * np.sin(1.2 * far[..., :1] + np.array([0, 2, 4]))
    return np.where(on_card, (0.8, 0.3, 0.2), wall), np.where(on_card, near, far)


def inverse_depth(camera):
    return 1 / camera.project(card(camera)[1])[1]


def depth_maps():
    """Return the exact inverse depth of the views, each with a scale and a shift of its own."""
    return [(2 + k) * inverse_depth(camera) + 0.5 * k for k, camera in enumerate(VIEWS)]


def surface_points():
    """Return every sixth point of the views [P, 3], hidden ones among them, the rays to them, and their colours."""
    found = [(card(camera)[1], card(camera)[1] - camera.position, card(camera)[0]) for camera in VIEWS]
    return tuple(
        np.concatenate([each[::6, ::6].reshape(-1, 3) for each in parts]) for parts in zip(*found, strict=True)
    )


def test_depth_prior__is_aligned_to_points():
    prior = depth_prior(depth_maps(), VIEWS, surface_points()[0])
    for camera, aligned in zip(VIEWS, prior.aligned, strict=True):
        assert_close(aligned.inverse, inverse_depth(camera), atol=2e-3)
        assert np.asarray(aligned.known).all()


def test_depth_prior__without_points_is_aligned_to_the_fit():
    prior = depth_prior(depth_maps(), VIEWS, np.zeros((0, 3)))
    assert prior.aligned == (None,) * 3
    points, _, colors = surface_points()
    fitted_so_far = dataclasses.replace(from_points(points, colors, 0), logit_opacities=np.full(len(points), 2.0))
    realigned = prior.realigned(fitted_so_far, [ActiveView(camera) for camera in VIEWS])
    for camera, aligned in zip(VIEWS, realigned.aligned, strict=True):
        assert not aligned.final
        # Large Gaussians are less exact than points.
        assert_close(aligned.inverse, inverse_depth(camera), atol=0.03)


def test_depth_prior__leaves_masked_pixels_out():
    upper = np.repeat(np.arange(48)[:, None] < 24, 64, axis=1)
    prior = depth_prior(depth_maps(), VIEWS, surface_points()[0], [None, upper, upper])
    assert np.asarray(prior.aligned[0].known).all()
    assert np.array_equal(np.asarray(prior.aligned[1].known), upper)


def test_depth_prior__that_contradicts_the_points_is_not_used():
    prior = depth_prior([-relative for relative in depth_maps()], VIEWS, surface_points()[0])
    assert prior.aligned == (None,) * 3


def test_depth_prior__reduced_is_the_mean_over_known_pixels():
    upper = np.repeat(np.arange(48)[:, None] < 25, 64, axis=1)
    prior = depth_prior(depth_maps(), VIEWS, surface_points()[0], [None, upper, upper])
    small = [VIEWS[2].resized(32, 24), VIEWS[0].resized(16, 12)]
    reduced = prior.reduced([2, 0], small)
    means = np.asarray(prior.aligned[0].inverse).reshape(12, 4, 16, 4).mean(axis=(1, 3))
    assert_close(reduced.aligned[1].inverse, means, atol=1e-5)
    # A row of which only a half is known is not.
    assert np.array_equal(np.asarray(reduced.aligned[0].known), np.repeat(np.arange(24)[:, None] < 12, 32, axis=1))
    assert np.array_equal(np.isfinite(reduced.relative[0]), np.asarray(reduced.aligned[0].known) > 0)


CONFIG = FitConfig(sh_degree=0, num_gaussians=500, first_frame_steps=100)


def fitted(prior, config=CONFIG):
    """Fit Gaussians that start from points whose distance from a camera is wrong by a tenth."""
    rng, (points, rays, colors) = np.random.default_rng(0), surface_points()
    start = from_points(points + 0.1 * rng.normal(size=(len(points), 1)) * rays, colors, 0)
    targets, render = [Target(card(camera)[0]) for camera in VIEWS], RenderConfig(reproducible=True)
    return fit_first_frame(start, VIEWS, targets, 3.0, config, render, np.random.default_rng(0), prior=prior)


def held_out_psnr(gaussians):
    """Return the mean PSNR of views between and beside the training views, dB."""
    return np.mean([psnr(np.asarray(rasterize(gaussians, c).color).clip(0, 1), card(c)[0]) for c in HELD_OUT])


@pytest.fixture(scope="module")
def unguided():
    return fitted(None).gaussians


@pytest.mark.parametrize("with_points", [True, False])
def test_fit_first_frame__has_better_held_out_views_with_depth(unguided, with_points):
    prior = depth_prior(depth_maps(), VIEWS, surface_points()[0] if with_points else np.zeros((0, 3)))
    guided = fitted(prior)
    assert held_out_psnr(guided.gaussians) > held_out_psnr(unguided) + 0.5
    assert {*guided.losses} == {"recon", "depth"}


def test_fit_first_frame__without_weight_is_the_same_to_the_bit(monkeypatch):
    rendered, prior = [], depth_prior(depth_maps(), VIEWS, surface_points()[0])
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


@pytest.mark.parametrize("trial", [cross_validate, compare_fits])
def test_trials__expect_more_of_other_views_with_depth(trial):
    points, rays, colors = surface_points()
    start = from_points(points + 0.1 * np.random.default_rng(0).normal(size=(len(points), 1)) * rays, colors, 0)
    views = [View(camera, np.uint8(255 * card(camera)[0] + 0.5)) for camera in VIEWS]
    # Without dropping, whose effect on so few Gaussians is larger than that of their depth, which is 0.3 dB and more.
    trials = CrossValidationConfig(candidates=(0.0,))
    config = dataclasses.replace(CONFIG, first_frame_steps=200, cross_validation=trials)
    given = start, views, 3.0, config, RenderConfig(reproducible=True), [0]
    without, guided = (trial(*given, prior=p) for p in (None, depth_prior(depth_maps(), VIEWS, points)))
    assert guided.expected_psnr > without.expected_psnr + 0.2


def test_fit_config__rejects_a_negative_depth_weight():
    with pytest.raises(ValueError, match="`depth_weight` must be finite and not negative, got -1"):
        FitConfig(depth_weight=-1.0)


def test_step__runs_the_network_of_the_settings(tmp_path):
    """A network that returns exact colours in place of depth is still a network: its term is part of the report."""
    fit = dataclasses.replace(
        CONFIG, first_frame_steps=8, dropping=0.0, depth_model=str(export(tmp_path / "tiny.onnx"))
    )
    images = [np.rint(255 * card(camera)[0]).astype(np.uint8) for camera in VIEWS]
    points, _, colors = surface_points()
    reports = [
        StreamLoop(VIEWS, points, colors, StreamConfig(fit=each)).push(images)[1]
        for each in (fit, dataclasses.replace(fit, depth_model=None))
    ]
    assert [set(report.losses) for report in reports] == [{"recon", "depth"}, {"recon"}]
    with pytest.raises(FileNotFoundError, match=r"missing\.onnx: expected an ONNX file"):
        StreamLoop(VIEWS, points, colors, StreamConfig(fit=dataclasses.replace(fit, depth_model="missing.onnx"))).push(
            images
        )

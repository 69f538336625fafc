"""Colour correction between cameras and over time: removal of differences between sensors and exposures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.color_correction import ColorCorrection, delta_e, fit_colors
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.core.color_space import linear_to_srgb, srgb_to_linear
from morgs_mi.io.video_writer import write_video
from tests.assertions import assert_close
from tests.scenes import textured

# Sensors with different cross-talk, white balance and exposure. The first is the reference.
SENSORS = np.array(
    [
        np.eye(3),
        [[0.80, 0.10, 0.00], [0.05, 0.85, 0.05], [0.00, 0.10, 0.70]],
        [[0.95, -0.10, 0.05], [0.00, 0.75, 0.10], [0.05, 0.00, 0.90]],
        np.diag([0.7, 0.8, 0.9]),
    ]
)


def linear(image: np.ndarray) -> np.ndarray:
    return srgb_to_linear(image / 255)


def encoded(light: np.ndarray) -> np.ndarray:
    return np.rint(255 * linear_to_srgb(np.clip(light, 0, 1))).astype(np.uint8)


def through(sensor: np.ndarray, image: np.ndarray, gain: float = 1.0) -> np.ndarray:
    return encoded(gain * linear(image) @ sensor.T)


@pytest.fixture(scope="module")
def views():
    """Four views of textured planes: cameras, true images, and images recorded by the sensors with slight noise."""
    cameras, planes, rng = textured.rig(4), textured.textures(), np.random.default_rng(0)
    true = [textured.render(camera, planes) for camera in cameras]
    noise = [rng.normal(0, 1.5, image.shape) for image in true]
    recorded = [
        np.clip(through(s, i) + n, 0, 255).round().astype(np.uint8)
        for s, i, n in zip(SENSORS, true, noise, strict=True)
    ]
    return cameras, true, recorded


def error(a: np.ndarray, b: np.ndarray) -> float:
    return float(delta_e(linear(a[::4, ::4].reshape(-1, 3)), linear(b[::4, ::4].reshape(-1, 3))).mean())


# The noise alone causes 0.9; polynomials fit some of it as colour.
@pytest.mark.parametrize(("method", "left"), [("linear", 1.3), ("root-polynomial", 1.6), ("vandermonde", 2.5)])
def test_fit_colors__removes_differences_between_sensors(views, method: str, left: float) -> None:
    cameras, true, recorded = views
    fit = fit_colors(cameras, recorded, [None] * 4, method, 0)
    assert (fit.reference, fit.matrices[0]) == (0, None)
    assert min(fit.samples) > 100
    assert all(after < 0.5 * before for before, after in zip(fit.before, fit.after, strict=True))
    for view in (1, 2, 3):
        before, after = (
            error(recorded[view], true[view]),
            error(ColorCorrection.of(fit, view, None)(recorded[view]), true[view]),
        )
        assert before > 4
        assert after < left, (view, before, after)
    if method == "linear":
        found = np.array([matrix for matrix in fit.matrices[1:]])
        assert_close(found @ SENSORS[1:], np.tile(np.eye(3), (3, 1, 1)), atol=0.03)


def test_fit_colors__leaves_matching_cameras_unchanged(views) -> None:
    cameras, true, _ = views
    fit = fit_colors(cameras, true, [None] * 4)
    for view in range(4):
        assert error(ColorCorrection.of(fit, view, None)(true[view]), true[view]) < 0.5
    assert all(after <= before + 0.1 for before, after in zip(fit.before, fit.after, strict=True))


def test_fit_colors__leaves_a_camera_without_shared_points_unchanged(views, caplog) -> None:
    cameras, _, recorded = views
    noise = np.random.default_rng(1).integers(0, 256, recorded[0].shape, np.uint8)
    for image in (noise, None):
        fit = fit_colors(cameras, [*recorded[:3], image], [None] * 4)
        assert fit.matrices[3] is None
        assert fit.samples[3] == 0
        assert np.isnan(fit.after[3])
    assert "cam3 keeps its colours: too few points" in caplog.text


def test_color_correction__removes_exposure_changes_despite_motion(views) -> None:
    """A third of the later image is occluded by something else."""
    image = views[1][0]
    correction = ColorCorrection.of(None, 0, image)
    assert correction.gain(image) == 1
    np.testing.assert_array_equal(correction(image), image)
    for gain in (0.7, 1.25):
        later = image.copy()
        later[:, :100] = np.random.default_rng(0).integers(0, 256, later[:, :100].shape, np.uint8)
        later = through(np.eye(3), later, gain)
        assert correction.gain(later) == pytest.approx(gain, rel=0.02)
        unclipped = (later < 250).all(-1)[:, 100:]
        # One grey level of a dark image corresponds to 1.4 of the bright one.
        assert np.abs(correction(later)[:, 100:].astype(int) - image[:, 100:])[unclipped].mean() < 2
    black = np.zeros_like(image)
    assert ColorCorrection.of(None, 0, black).gain(image) == 1


@pytest.fixture(scope="module")
def flickering(views, tmp_path_factory) -> Path:
    """The four views for three frames, cam2 flickering: 1, 0.8, 1.2."""
    path = tmp_path_factory.mktemp("color") / "capture"
    cameras, _, recorded = views
    write_colmap(path / "sparse/0", cameras)
    for camera, image in zip(cameras, recorded, strict=True):
        gains = (1, 0.8, 1.2) if camera.name == "cam2" else (1, 1, 1)
        write_video(path / camera.name, [through(np.eye(3), image, gain) for gain in gains], 25)
    return path


def test_load_capture__corrects_colors_and_reports_it(flickering: Path, views, capsys) -> None:
    _, true, recorded = views
    config = ReadConfig(color="linear:cam0", exposure=True)
    capture = load_capture(flickering, reading=config)
    for frame in capture.frames():
        np.testing.assert_array_equal(frame.images[0], recorded[0])
        assert all(error(frame.images[view], true[view]) < 2 for view in (1, 2, 3))
    flicker = [frame.images[2].mean() for frame in load_capture(flickering).frames()]
    steady = [frame.images[2].mean() for frame in load_capture(flickering, reading=ReadConfig(exposure=True)).frames()]
    assert np.ptp(steady) < 0.15 * np.ptp(flicker)
    metadata = capture.metadata()["colors"]
    assert metadata["reference"] == "cam0"
    assert all(a < 0.5 * b for b, a in zip(metadata["delta_e_before"], metadata["delta_e"], strict=True))
    assert cli.main(["info", str(flickering), "--color", "linear", "--no-check"]) == 0
    assert "dE2000 before -> after: cam0 " in capsys.readouterr().out


@pytest.mark.parametrize("color", ["linear:cam9", "cubic", "cubic:cam0", ""])
def test_load_capture__refuses_an_unknown_method_or_reference_camera(flickering: Path, color: str) -> None:
    message = f"`color` must be none, linear, .*with a camera of cam0, cam1, cam2, cam3, .*got '{color}'"
    with pytest.raises(ValueError, match=message):
        load_capture(flickering, reading=ReadConfig(color=color))

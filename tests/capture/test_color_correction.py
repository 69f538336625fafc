"""Colour correction between cameras: removal of differences between sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.color_correction import ColorFit, delta_e, fit_colors
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.core.color_space import decode_light, encode_light
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
    return decode_light(image / 255)


def encoded(light: np.ndarray) -> np.ndarray:
    return np.rint(255 * encode_light(np.clip(light, 0, 1))).astype(np.uint8)


def through(sensor: np.ndarray, image: np.ndarray, gain: float = 1.0) -> np.ndarray:
    return encoded(gain * linear(image) @ sensor.T)


@pytest.fixture(scope="module")
def views():
    """Four views of textured planes: cameras, true images, and images recorded by the sensors with
    slight noise.
    """
    cameras = textured.rig(4)
    planes = textured.textures()
    rng = np.random.default_rng(0)
    true = [textured.render(camera, planes) for camera in cameras]
    noise = [rng.normal(0, 1.5, image.shape) for image in true]
    recorded = [
        np.clip(through(s, i) + n, 0, 255).round().astype(np.uint8)
        for s, i, n in zip(SENSORS, true, noise, strict=True)
    ]
    return cameras, true, recorded


def error(a: np.ndarray, b: np.ndarray) -> float:
    return float(
        delta_e(linear(a[::4, ::4].reshape(-1, 3)), linear(b[::4, ::4].reshape(-1, 3))).mean()
    )


def corrected(fit: ColorFit, view: int, image: np.ndarray) -> np.ndarray:
    correction = fit.correction(view)
    return image if correction is None else correction(image)


def test_fit_colors__removes_differences_between_sensors(views) -> None:
    cameras, true, recorded = views
    fit = fit_colors(cameras, recorded, [None] * 4, 0)
    assert (fit.reference, fit.matrices[0]) == (0, None)
    assert min(fit.samples) > 100
    assert all(
        new_error < 0.5 * old_error
        for old_error, new_error in zip(fit.recorded_delta_e, fit.delta_e, strict=True)
    )
    for view in (1, 2, 3):
        old_error = error(recorded[view], true[view])
        new_error = error(corrected(fit, view, recorded[view]), true[view])
        assert old_error > 4
        assert new_error < 1.3, (view, old_error, new_error)  # the noise alone causes 0.9
    matrices = np.array([matrix for matrix in fit.matrices[1:]])
    assert_close(matrices @ SENSORS[1:], np.tile(np.eye(3), (3, 1, 1)), atol=0.03)


def test_fit_colors__leaves_matching_cameras_unchanged(views) -> None:
    cameras, true, _ = views
    fit = fit_colors(cameras, true, [None] * 4)
    for view in range(4):
        assert error(corrected(fit, view, true[view]), true[view]) < 0.5
    assert all(
        new_error <= old_error + 0.1
        for old_error, new_error in zip(fit.recorded_delta_e, fit.delta_e, strict=True)
    )


def test_fit_colors__leaves_a_camera_without_shared_points_unchanged(views, caplog) -> None:
    cameras, _, recorded = views
    noise = np.random.default_rng(1).integers(0, 256, recorded[0].shape, np.uint8)
    for image in (noise, None):
        fit = fit_colors(cameras, [*recorded[:3], image], [None] * 4)
        assert fit.matrices[3] is None
        assert fit.samples[3] == 0
        assert np.isnan(fit.delta_e[3])
    assert "cam3 keeps its colours: too few points" in caplog.text


@pytest.fixture(scope="module")
def recording(views, tmp_path_factory) -> Path:
    """A capture of the four views, of two equal frames."""
    path = tmp_path_factory.mktemp("color") / "capture"
    cameras, _, recorded = views
    write_colmap(path / "sparse/0", cameras)
    for camera, image in zip(cameras, recorded, strict=True):
        write_video(path / camera.name, [image] * 2, 25)
    return path


@pytest.mark.slow
def test_load_capture__corrects_colors_and_reports_it(recording: Path, views, capsys) -> None:
    _, true, recorded = views
    capture = load_capture(recording, reading=ReadConfig(color="linear:cam0"))
    for frame in capture.frames():
        np.testing.assert_array_equal(frame.images[0], recorded[0])
        assert all(error(frame.images[view], true[view]) < 2 for view in (1, 2, 3))
    metadata = capture.metadata()["colors"]
    assert metadata["reference"] == "cam0"
    assert all(
        a < 0.5 * b for b, a in zip(metadata["delta_e_before"], metadata["delta_e"], strict=True)
    )
    assert cli.main(["info", str(recording), "--color", "linear", "--no-check"]) == 0
    assert "dE2000 before -> after: cam0 " in capsys.readouterr().out


def test_load_capture__refuses_an_unknown_reference_camera(recording: Path) -> None:
    message = (
        "`color` must be none, linear, .*with a camera of cam0, cam1, cam2, cam3, .*got "
        "'linear:cam9'"
    )
    with pytest.raises(ValueError, match=message):
        load_capture(recording, reading=ReadConfig(color="linear:cam9"))


@pytest.mark.parametrize("color", ["cubic", "cubic:cam0", ""])
def test_read_config__refuses_an_unknown_method(color: str) -> None:
    with pytest.raises(
        ValueError, match=rf"ReadConfig\(\): `color` must be none, linear, .* got '{color}'"
    ):
        ReadConfig(color=color)

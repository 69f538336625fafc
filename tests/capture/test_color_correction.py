"""Colours between cameras and over time: what other sensors and exposures did to them is undone."""

from __future__ import annotations

from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from morgs_mi import cli
from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.color_correction import COLOR_METHODS, ColorCorrection, delta_e, fit_colors
from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.io.video_writer import write_video
from tests.capture import textured

# Sensors that differ: cross-talk, white balance, exposure. The first is the reference.
SENSORS = np.array(
    [
        np.eye(3),
        [[0.80, 0.10, 0.00], [0.05, 0.85, 0.05], [0.00, 0.10, 0.70]],
        [[0.95, -0.10, 0.05], [0.00, 0.75, 0.10], [0.05, 0.00, 0.90]],
        np.diag([0.7, 0.8, 0.9]),
    ]
)


def linear(image: np.ndarray) -> np.ndarray:
    codes = image / 255
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


def encoded(light: np.ndarray) -> np.ndarray:
    light = np.clip(light, 0, 1)
    return np.rint(255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)).astype(
        np.uint8
    )


def through(sensor: np.ndarray, image: np.ndarray, gain: float = 1.0) -> np.ndarray:
    return encoded(gain * linear(image) @ sensor.T)


@pytest.fixture(scope="module")
def views():
    """Four views of textured planes, as they are and as the sensors saw them, a little noisy."""
    cameras, planes, rng = textured.rig(4), textured.textures(), np.random.default_rng(0)
    true = [textured.render(camera, planes) for camera in cameras]
    noise = [rng.normal(0, 1.5, image.shape) for image in true]
    seen = [
        np.clip(through(s, i) + n, 0, 255).round().astype(np.uint8)
        for s, i, n in zip(SENSORS, true, noise, strict=True)
    ]
    return cameras, true, seen


def error(a: np.ndarray, b: np.ndarray) -> float:
    return float(delta_e(linear(a[::4, ::4].reshape(-1, 3)), linear(b[::4, ::4].reshape(-1, 3))).mean())


# What the noise alone costs is 0.9; polynomials take some of what is not colour for colour.
@pytest.mark.parametrize(("method", "left"), [("linear", 1.3), ("root-polynomial", 1.6), ("vandermonde", 2.5)])
def test_what_sensors_did_is_undone(views, method: str, left: float) -> None:
    cameras, true, seen = views
    fit = fit_colors(cameras, seen, [None] * 4, method, 0)
    assert (fit.reference, fit.matrices[0]) == (0, None)
    assert min(fit.samples) > 100
    assert all(after < 0.5 * before for before, after in zip(fit.before, fit.after, strict=True))
    for view in (1, 2, 3):
        before, after = (
            error(seen[view], true[view]),
            error(ColorCorrection.of(fit, view, None)(seen[view]), true[view]),
        )
        assert before > 4
        assert after < left, (view, before, after)
    if method == "linear":
        found = np.array([matrix for matrix in fit.matrices[1:]])
        np.testing.assert_allclose(found @ SENSORS[1:], np.tile(np.eye(3), (3, 1, 1)), atol=0.03)


def test_cameras_that_agree_are_left_as_they_are(views) -> None:
    cameras, true, _ = views
    fit = fit_colors(cameras, true, [None] * 4)
    for view in range(4):
        assert error(ColorCorrection.of(fit, view, None)(true[view]), true[view]) < 0.5
    assert all(after <= before + 0.1 for before, after in zip(fit.before, fit.after, strict=True))


def test_a_camera_with_nothing_in_common_keeps_its_colours(views, caplog) -> None:
    cameras, _, seen = views
    noise = np.random.default_rng(1).integers(0, 256, seen[0].shape, np.uint8)
    for picture in (noise, None):
        fit = fit_colors(cameras, [*seen[:3], picture], [None] * 4)
        assert fit.matrices[3] is None
        assert fit.samples[3] == 0
        assert np.isnan(fit.after[3])
    assert "cam3 keeps its colours: too few points" in caplog.text


def test_a_change_of_exposure_is_undone_whatever_moves(views) -> None:
    """A third of the picture is covered by something else meanwhile."""
    picture = views[1][0]
    tone = ColorCorrection.of(None, 0, picture)
    assert tone.gain(picture) == 1
    np.testing.assert_array_equal(tone(picture), picture)
    for gain in (0.7, 1.25):
        later = picture.copy()
        later[:, :100] = np.random.default_rng(0).integers(0, 256, later[:, :100].shape, np.uint8)
        later = through(np.eye(3), later, gain)
        assert tone.gain(later) == pytest.approx(gain, rel=0.02)
        unclipped = (later < 250).all(-1)[:, 100:]
        # A code value of a dim picture is 1.4 of the bright one's.
        assert np.abs(tone(later)[:, 100:].astype(int) - picture[:, 100:])[unclipped].mean() < 2
    black = np.zeros_like(picture)
    assert ColorCorrection.of(None, 0, black).gain(picture) == 1


@pytest.fixture(scope="module")
def flickering(views, tmp_path_factory) -> Path:
    """The four views for three frames, cam2 flickering: 1, 0.8, 1.2."""
    path = tmp_path_factory.mktemp("color") / "capture"
    cameras, _, seen = views
    write_colmap(path / "sparse/0", cameras)
    for camera, image in zip(cameras, seen, strict=True):
        gains = (1, 0.8, 1.2) if camera.name == "cam2" else (1, 1, 1)
        write_video(path / camera.name, [through(np.eye(3), image, gain) for gain in gains], 25)
    return path


def test_captures_are_corrected_as_they_are_read_and_say_so(flickering: Path, views, capsys) -> None:
    _, true, seen = views
    config = ReadConfig(color="linear", color_reference="cam0", exposure=True)
    capture = load_capture(flickering, reading=config)
    for frame in capture.frames():
        np.testing.assert_array_equal(frame.images[0], seen[0])
        assert all(error(frame.images[view], true[view]) < 2 for view in (1, 2, 3))
    flicker = [frame.images[2].mean() for frame in load_capture(flickering).frames()]
    steady = [frame.images[2].mean() for frame in load_capture(flickering, reading=ReadConfig(exposure=True)).frames()]
    assert np.ptp(steady) < 0.15 * np.ptp(flicker)
    record = capture.record()["colors"]
    assert record["reference"] == "cam0"
    assert all(a < 0.5 * b for b, a in zip(record["delta_e_before"], record["delta_e"], strict=True))
    assert cli.main(["info", str(flickering), "--color", "linear", "--no-check"]) == 0
    assert "dE2000 before -> after: cam0 " in capsys.readouterr().out


def test_bad_settings_get_a_sentence(flickering: Path) -> None:
    with pytest.raises(ValueError, match="`color_reference` must be one of cam0, cam1, cam2, cam3, got 'cam9'"):
        load_capture(flickering, reading=ReadConfig(color="linear", color_reference="cam9"))
    assert {"none", *COLOR_METHODS} == set(get_args(get_type_hints(ReadConfig)["color"]))

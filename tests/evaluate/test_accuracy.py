"""Error against run time of the renderer, compared with a reference in float64."""

import sys

import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console

from benchmarks.workloads import ball
from morgs_mi import RenderConfig, accuracy
from morgs_mi.evaluate import accuracy as module
from morgs_mi.evaluate.accuracy import ATTRIBUTES, reference64
from tests import reference
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import as_float32, isotropic, make_scene, to_gaussians


@pytest.mark.parametrize("antialiased", [False, True])
def test_reference64__agrees_with_the_reference_of_the_tests(antialiased, monkeypatch):
    monkeypatch.setattr(module, "PAIRS", 200)  # several chunks of pixels
    raw = as_float32(make_scene(3, 6, logits=(-1.5, 7)))  # some pixels reach the cap of alpha
    raw["means"][0] = (0, 0, -9)  # behind the camera
    camera = make_camera(13, 9)
    pixels = np.argwhere(np.ones((9, 13)))[:, ::-1]
    weight = np.random.default_rng(3).normal(size=(len(pixels), 3))

    def values(raw):
        image = reference.rasterize_view(
            raw, camera, viewmat=camera.viewmat, antialiased=antialiased
        )
        return image["color"].reshape(-1, 3)

    config = RenderConfig(antialiased=antialiased)
    colors, gradients = reference64(to_gaussians(raw), camera, pixels, weight, config)
    assert np.abs(colors - values(raw)).max() < 1e-13
    names = list(ATTRIBUTES)
    expected = reference.complex_step(lambda raw: np.sum(values(raw) * weight), raw, names)
    for name, gradient in gradients.items():
        assert np.abs(gradient - expected[name]).max() < 1e-11 * np.abs(expected[name]).max(), name


@pytest.fixture
def few_settings(monkeypatch):
    """Two settings and two rounds, which take seconds."""
    names = ("1/255, 0.01", "1/65280, 1e-06")
    monkeypatch.setattr(module, "CHANGES", {name: module.CHANGES[name] for name in names})
    monkeypatch.setattr(module, "ROUNDS", 2)


def test_accuracy__selects_the_fastest_setting_within_the_tolerance(few_settings):
    gaussians, camera = ball(0, 300, 40, 24, 0.1, 1)
    result = accuracy(gaussians, camera)
    coarse, fine = result.rows
    assert set(fine.errors) == {"image", *ATTRIBUTES}
    for name, error in fine.errors.items():
        assert 1e-9 < error < 1e-3 < coarse.errors[name], name
    assert (
        result.config == fine.config == RenderConfig(alpha_min=1 / 65280, stop_transmittance=1e-6)
    )
    assert accuracy(gaussians, camera, tolerance=1e-8).config is None
    assert accuracy(gaussians, camera, RenderConfig(antialiased=True)).config.antialiased


def test_accuracy__errors_of_gradients_that_vanish_are_relative_to_the_others(few_settings):
    """Rotations of spheres have no gradient."""
    gaussians, camera = ball(0, 300, 40, 24, 0.1, 1)
    raw = gaussians.numpy()
    raw["log_scales"][:] = np.log(0.1)
    fine = accuracy(to_gaussians(raw), camera).rows[1]
    assert fine.errors["quats"] < 1e-3


def test_accuracy__is_shown_as_table_and_plot_or_without_matplotlib(few_settings, monkeypatch):
    result = accuracy(*ball(0, 300, 40, 24, 0.1, 1))
    console = Console(width=200, record=True)
    console.print(result.table())
    assert max(map(len, console.export_text().splitlines())) <= 80
    assert {"machine", "versions"} <= result.as_dict().keys()
    html = result._repr_html_()
    assert "1/65280, 1e-06" in html
    assert "<svg" in html
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    html = result._repr_html_()
    assert "1/255" in html
    assert "<svg" not in html


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gaussians": "a.ply"}, r"rasterize\(\): `gaussians` must be Gaussians, got a str"),
        ({"gaussians": isotropic(np.zeros((0, 3)), 1, 0.5, (1, 1, 1))}, "must see Gaussians in"),
        ({"gaussians": isotropic([[0, 0, -5]], 0.1, 0.5, (1, 1, 1))}, "must see .*, got none; cho"),
        ({"camera": None}, r"Camera\.from_sensor\(\): `sensor` must be a `perspective` sensor"),
        ({"config": {}}, r"accuracy\(\): `config` must be a .*RenderConfig, got a dict"),
        ({"tolerance": float("nan")}, r"`tolerance` must be a number in \(0, inf\), got nan"),
        ({"tolerance": -1}, r"`tolerance` must be a number in \(0, inf\), got -1"),
    ],
)
def test_accuracy__refuses_bad_arguments(changes, message):
    gaussians = isotropic([[0, 0, 3]], 0.1, 0.5, (1, 1, 1))
    arguments = {"gaussians": gaussians, "camera": make_camera(13, 9), **changes}
    with pytest.raises(ValueError, match=message):
        accuracy(**arguments)


def test_accuracy__takes_a_sensor_of_mitsuba(few_settings):
    gaussians, camera = ball(0, 300, 40, 24, 0.1, 1)
    camera = camera.square()
    expected = accuracy(gaussians, camera)
    result = accuracy(gaussians, mi.load_dict(camera.sensor()))
    for row, other in zip(result.rows, expected.rows, strict=True):
        assert row.errors["image"] == pytest.approx(other.errors["image"], rel=0.2)

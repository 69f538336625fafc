"""Error against run time of the renderer, compared with a reference in float64."""

import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console

from morgs_mi import RenderConfig, accuracy
from morgs_mi.evaluate import accuracy as module
from morgs_mi.evaluate.accuracy import ATTRIBUTES, Setting, chosen, reference64
from tests import reference
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import as_float32, ball, isotropic, make_scene, to_gaussians


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
    assert result.sentence.startswith("Within 0.001 in 1 camera: 1/65280, 1e-06, ")
    none = accuracy(gaussians, camera, tolerance=1e-8)
    assert none.config is None
    assert "None of the settings is within 1e-08 in 1 camera: the most exact, 1/65" in none.sentence
    assert accuracy(gaussians, camera, RenderConfig(antialiased=True)).config.antialiased


def row(name, seconds, error, checked=0.0):
    return Setting(name, RenderConfig(), seconds, {"image": error, "means": error / 2}, checked)


@pytest.mark.parametrize(
    ("rows", "name"),
    [
        ([row("a", 1.0, 1e-4), row("b", 1.04, 1e-5), row("c", 1.2, 1e-6)], "b"),
        ([row("a", 1.0, 2e-3), row("b", 1.5, 1e-4)], "b"),
        ([row("a", 1.0, 1e-4, 2e-3), row("b", 1.5, 1e-4, 1e-4)], "b"),
        ([row("a", 1.0, 2e-3)], None),
    ],
)
def test_chosen__is_the_most_exact_of_the_fast_settings_within_the_tolerance(rows, name):
    choice = chosen(rows, 1e-3)
    assert (choice and choice.name) == name


def test_accuracy__counts_the_worst_of_several_cameras(few_settings):
    gaussians, camera = ball(0, 300, 40, 24, 0.1, 1)
    other = replace(camera, K=camera.K * [[3, 1, 1], [1, 3, 1], [1, 1, 1]])
    both = accuracy(gaussians, [camera, other])
    worst = [accuracy(gaussians, view).rows for view in (camera, other)]
    assert both.num_cameras == 2
    for k, setting in enumerate(both.rows):
        errors = [rows[k].errors["image"] for rows in worst]
        assert setting.errors["image"] == pytest.approx(max(errors), rel=0.5)


def test_accuracy__finds_an_object_of_few_pixels(few_settings):
    """It is on four of 10,000 pixels, which 512 random pixels of the image would miss."""
    gaussians = isotropic([[0, 0, 3]], 0.01, 0.9, (1, 1, 1))
    result = accuracy(gaussians, make_camera(100, 100))
    assert result.config is not None
    assert result.rows[1].error < 1e-3


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
        ({"gaussians": isotropic(np.zeros((0, 3)), 1, 0.5, (1, 1, 1))}, "must see Gaussians, got"),
        ({"gaussians": isotropic([[0, 0, -5]], 0.1, 0.5, (1, 1, 1))}, "must see .*, got none; cho"),
        ({"cameras": None}, r"Camera\.from_sensor\(\): `sensor` must be a `perspective` sensor"),
        ({"cameras": []}, r"`cameras` must have a camera, got none"),
        ({"config": {}}, r"accuracy\(\): `config` must be a .*RenderConfig, got a dict"),
        ({"tolerance": float("nan")}, r"`tolerance` must be a number in \(0, inf\), got nan"),
        ({"tolerance": -1}, r"`tolerance` must be a number in \(0, inf\), got -1"),
    ],
)
def test_accuracy__refuses_bad_arguments(changes, message):
    gaussians = isotropic([[0, 0, 3]], 0.1, 0.5, (1, 1, 1))
    arguments = {"gaussians": gaussians, "cameras": make_camera(13, 9), **changes}
    with pytest.raises(ValueError, match=message):
        accuracy(**arguments)


def test_accuracy__takes_a_sensor_of_mitsuba(few_settings):
    gaussians, camera = ball(0, 300, 40, 24, 0.1, 1)
    camera = camera.square()
    expected = accuracy(gaussians, camera)
    result = accuracy(gaussians, mi.load_dict(camera.sensor()))
    for row, other in zip(result.rows, expected.rows, strict=True):
        assert row.errors["image"] == pytest.approx(other.errors["image"], rel=0.2)

"""The scripts in examples/ run, are short, and write pictures of what they promise."""

import runpy
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import morgs_mi
from morgs_mi.method import objective
from morgs_mi.method.method_registry import Registry
from tests.scenes.gaussians import make_unit_scene, to_gaussians

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
# The picture of each script, in pixels.
SIZES = {
    "optimise": (3 * 96, 96),
    "fit_cameras": (4 * 96, 72),
    "fit_sensors": (2 * 160, 120),
    "own_fit": (2 * 160, 120),
    "own_loss": (2 * 96, 72),
    "meshes": (240, 160),
}


def run(name, *arguments):
    """Run a script with arguments, the last of which is a picture, and return the picture."""
    (path,) = (path for path in EXAMPLES if path.stem == name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(path), *map(str, arguments)])
        runpy.run_path(str(path))
    mi.Thread.wait_for_tasks()  # of mi.util.write_bitmap
    return np.array(mi.Bitmap(str(arguments[-1])))


def test_examples__are_short():
    assert sorted(path.stem for path in EXAMPLES) == sorted((*SIZES, "render_ply"))
    assert [
        path.name for path in EXAMPLES if len(path.read_text(encoding="utf-8").splitlines()) >= 40
    ] == []


@pytest.mark.slow
def test_examples__fit_alike_by_a_call_and_by_a_loop(tmp_path):
    scores = []
    for name in ("fit_sensors", "own_fit"):
        truth, image = np.split(run(name, tmp_path / "picture.png") / 255, 2, axis=1)
        scores.append(-10 * np.log10(np.square(image - truth).mean()))
    assert min(scores) > 38
    assert abs(scores[0] - scores[1]) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SIZES if name not in ("fit_sensors", "own_fit")])
def test_examples__write_a_picture(name, tmp_path, monkeypatch):
    # `own_loss` registers a term for the whole process.
    registry = Registry("ObjectiveConfig()", "terms", objective.ObjectiveConfig)
    monkeypatch.setattr(objective, "LOSS_TERMS", registry)
    picture = run(name, tmp_path / "picture.png")
    assert picture.shape == (*reversed(SIZES[name]), 3)
    assert picture.std() > 5
    if name == "own_loss":
        free, slowed = np.split(np.ptp(picture, axis=2), 2, axis=1)  # speeds
        assert slowed.mean() < 0.7 * free.mean()
    if name == "optimise":
        start, result, target = np.split(picture.astype(float), 3, axis=1)
        assert np.abs(result - target).mean() < 0.3 * np.abs(start - target).mean()


def test_examples__render_a_file(tmp_path):
    morgs_mi.write_ply(tmp_path / "scene.ply", to_gaussians(make_unit_scene()))
    image = run("render_ply", tmp_path / "scene.ply", tmp_path / "render.exr")
    assert image.shape[2] == 4
    assert image[..., :3].std() > 0.05
    assert image[..., 3].max() > 0

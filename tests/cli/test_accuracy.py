"""`morgs-mi accuracy`: table, plot and JSON of a file of Gaussians and of a stream."""

import pytest

from morgs_mi import write_ply
from morgs_mi.evaluate import accuracy as module
from morgs_mi.platform.bounded import read_json
from tests.cli.commands import assert_refused
from tests.scenes.gaussians import ball


@pytest.fixture
def scene(tmp_path, monkeypatch):
    names = ("1/255, 0.01", "1/65280, 1e-06")
    monkeypatch.setattr(module, "CHANGES", {name: module.CHANGES[name] for name in names})
    monkeypatch.setattr(module, "ROUNDS", 2)
    write_ply(tmp_path / "scene.ply", ball(0, 300, 40, 24, 0.1, 1)[0])
    return tmp_path / "scene.ply"


def test_accuracy__writes_plot_and_json_beside_the_file_or_as_named(run, scene, tmp_path):
    status, text, _ = run("accuracy", scene)
    assert status == 0
    assert "1/65280, 1e-06 *" in text
    assert scene.with_name("scene-accuracy.png").read_bytes().startswith(b"\x89PNG")
    result = read_json(scene.with_name("scene-accuracy.json"))
    assert result["config"]["alpha_min"] == 1 / 65280
    more = ("--camera", "left", "--tolerance", "1e-8")
    assert run("accuracy", scene, tmp_path / "a.svg", *more)[0] == 0
    assert "<svg" in (tmp_path / "a.svg").read_text()
    assert read_json(tmp_path / "a.json")["config"] is None
    assert_refused(run("accuracy", scene, tmp_path / "a.txt"), "suffix of a plot")

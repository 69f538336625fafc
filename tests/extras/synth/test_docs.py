"""The example of docs/scenes.md is rendered as the page describes."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.truth import load_truth
from morgs_mi.cli.main import main
from morgs_mi.extras.synth.disturbances import Disturbances, load_disturbances
from morgs_mi.extras.synth.synth_config import SynthConfig
from morgs_mi.extras.synth.synthesize import synthesize

TEXT = (Path(__file__).parents[3] / "docs" / "scenes.md").read_text(encoding="utf-8")
(SCENE,) = re.findall(r"<!-- file ball.py -->\n```python\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.slow
def test_scenes_page__example_is_rendered_with_its_moving_ball(tmp_path):
    (tmp_path / "ball.py").write_text(SCENE)
    size = SynthConfig(cameras=2, frames=2, width=64, height=48, spp=4)
    truth = load_truth(
        synthesize(tmp_path / "ball.py", tmp_path / "out", size) / "truth", "cam00", 1
    )
    assert truth.mask.sum() > 40
    assert np.linalg.norm(truth.motion[truth.mask], axis=-1).mean() > 0.2


SMALL = ("--cameras", "2", "--frames", "2", "--width", "32", "--height", "24", "--spp", "1")
COMMANDS = [line.split() for line in re.findall(r"^    morgs-mi (synth .+)", TEXT, re.MULTILINE)]


@pytest.mark.slow
@pytest.mark.parametrize("command", [c for c in COMMANDS if "ball.py" not in c[1]], ids=" ".join)
def test_scenes_page__commands_run(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    assert main([*command, *SMALL]) == 0
    drawn = load_disturbances(Path(command[2]) / "truth").values()
    for field in fields(Disturbances):
        option = f"--{field.name.replace('_', '-')}"
        assert f"`{option}`" in TEXT
        assert any(getattr(disturbance, field.name) for disturbance in drawn) == (option in command)


@pytest.mark.slow
def test_scenes_page__lists_the_files_of_a_capture(clip):
    listed = {
        name.split("/")[0]
        for name in re.findall(r"^\| (.+?) \|", TEXT, re.MULTILINE)
        for name in re.findall(r"`([^`]+)`", name)
    }
    assert listed - {"cam00.mp4"} == {f.name for f in clip.iterdir() if f.suffix != ".mp4"}

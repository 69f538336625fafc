"""Times of a later frame by stage."""

from __future__ import annotations

import cProfile
import re
from pathlib import Path

import numpy as np
import pytest

import morgs_mi
from benchmarks.speed import frame_speed
from benchmarks.speed.frame_speed import STAGES, Scene, Size
from morgs_mi.method.ssim import Target

SIZE = Size(64, 48, 3, 600, 2)


@pytest.mark.parametrize("name", STAGES)
def test_stages__are_functions_of_the_package(name: str):
    file, function = STAGES[name]
    source = (Path(morgs_mi.__file__).parent / file).read_text(encoding="utf-8")
    assert re.search(rf"^\s*def {function}\(", source, re.MULTILINE)


def test_stages__times_a_profiled_function():
    profile = cProfile.Profile()
    profile.runcall(Target, np.zeros((24, 32, 3), np.uint8))
    seconds = frame_speed.stages(profile)
    assert seconds.keys() == STAGES.keys()
    assert seconds["targets"] > 0
    assert seconds["lift"] == 0


def test_scene__moves_the_given_number_of_balls():
    scene = Scene(SIZE, seed=0)
    before, after = (np.asarray(scene.at(t).means) for t in (0, 1))
    assert len(before) <= SIZE.gaussians
    moved = np.linalg.norm(after - before, axis=1) > 0
    assert set(scene.owner[moved]) == set(scene.moving)
    assert len(scene.cameras()) == SIZE.views + 1


@pytest.mark.slow
def test_measure__reports_stages_bytes_and_quality():
    scene = Scene(SIZE, seed=0)
    config = frame_speed.config_of(SIZE, epochs=1, skip_static=False)
    result = frame_speed.measure(scene, config, scene.recorded(4, seed=0))
    stages = {f"{name}_s" for name in STAGES}
    assert stages | {"seconds", "bytes", "psnr", "gaussians", "views", "pixels", "epochs"} <= result.keys()
    assert min(result[name] for name in ("seconds", "flow_s", "lift_s", "steps_s", "packet_s", "bytes")) > 0
    assert 10 < result["psnr"] < 60

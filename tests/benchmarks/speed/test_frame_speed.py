"""Times of a later frame."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.speed import frame_speed
from benchmarks.speed.frame_speed import Scene, Size

SIZE = Size(64, 48, 3, 600, 2)


def test_scene__moves_the_given_number_of_balls():
    scene = Scene(SIZE, seed=0)
    first, second = (np.asarray(scene.at(t).means) for t in (0, 1))
    assert len(first) <= SIZE.gaussians
    mask = np.linalg.norm(second - first, axis=1) > 0
    assert set(scene.owner[mask]) == set(scene.moving)
    assert len(scene.cameras()) == SIZE.views + 1


@pytest.mark.slow
def test_measure__reports_time_bytes_and_quality():
    scene = Scene(SIZE, seed=0)
    config = frame_speed.config_of(SIZE, epochs=1, skip_static=False)
    result = frame_speed.measure(scene, config, scene.recorded(4, seed=0))
    assert {"seconds", "bytes", "psnr", "gaussians", "views", "pixels", "epochs"} <= result.keys()
    assert min(result[name] for name in ("seconds", "bytes")) > 0
    assert 10 < result["psnr"] < 60

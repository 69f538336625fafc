"""`morgs-mi synth`."""

from __future__ import annotations

from pathlib import Path

import pytest

from morgs_mi.studio.synth.disturbances import load_disturbances
from tests.cli.commands import assert_refused

SIZE = ("--cameras", 2, "--frames", 2, "--width", 32, "--height", 24, "--spp", 1)


@pytest.mark.slow
def test_synth__renders_a_scene_with_disturbances(tmp_path: Path, run) -> None:
    hard = ("--time-offset", 0.5, "--rolling-shutter", 0.4)
    status, _, error = run("synth", "spheres", tmp_path / "out", *SIZE, *hard)
    assert status == 0, error
    disturbances = load_disturbances(tmp_path / "out" / "truth")
    assert list(disturbances) == ["cam00", "cam01"]
    assert disturbances["cam01"].time_offset != 0
    assert disturbances["cam00"].rolling_shutter == 0.4


def test_synth__names_wrong_options(tmp_path: Path, run) -> None:
    assert_refused(
        run("synth", "spheres", tmp_path / "out", *SIZE, "--rolling-shutter", 2),
        "--rolling-shutter must be at least 0 and at most 1, got 2.0",
    )
    assert not (tmp_path / "out").exists()

"""`morgs-mi synth`."""

from __future__ import annotations

from pathlib import Path

import pytest

from morgs_mi.synth.disturbances import load_disturbances
from tests.cli.commands import assert_refused
from tests.scenes.animated_gltf import write_glb

SIZE = ("--cameras", 2, "--frames", 2, "--width", 32, "--height", 24, "--spp", 1)


@pytest.mark.parametrize("text", ["[" * 100_000, "[]"])
def test_synth__replaces_no_folder_with_a_hostile_description(tmp_path: Path, run, text: str) -> None:
    (tmp_path / "capture.json").write_text(text)
    assert_refused(run("synth", "arm", tmp_path, "--overwrite"), "is not a synthetic capture")


def test_synth__renders_an_animated_model_with_disturbances(tmp_path: Path, run) -> None:
    hard = ("--time-offset", 0.5, "--rolling-shutter", 0.4, "--jpeg-quality", 60, "--animation", "bend")
    status, _, error = run("synth", write_glb(tmp_path / "model.glb"), tmp_path / "out", *SIZE, *hard)
    assert status == 0, error
    found = load_disturbances(tmp_path / "out" / "truth")
    assert list(found) == ["cam00", "cam01"]
    assert found["cam01"].time_offset != 0
    assert (found["cam00"].rolling_shutter, found["cam00"].jpeg_quality) == (0.4, 60)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("spheres", "--rolling-shutter", 2), "--rolling-shutter must be at least 0 and at most 1, got 2.0"),
        (("spheres", "--animation", "run"), "--animation is for glTF files, got another scene"),
        (("MODEL", "--animation", "run"), "--animation must be one of 'bend', 'rest' of"),
        (("nowhere.glb",), "nowhere.glb: expected a glTF file, got none; check the path"),
    ],
)
def test_synth__names_wrong_options(tmp_path: Path, run, args: tuple, message: str) -> None:
    scene, *options = args
    scene = write_glb(tmp_path / "model.glb") if scene == "MODEL" else scene
    assert_refused(run("synth", scene, tmp_path / "out", *SIZE, *options), message)
    assert not (tmp_path / "out").exists()

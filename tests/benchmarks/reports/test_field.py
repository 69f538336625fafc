"""Report on the field's methods: a tiny clip."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.reports import field
from benchmarks.reports.field import METHODS, Options, field_table
from morgs_mi.studio.synth.synth_config import SynthConfig
from morgs_mi.studio.synth.synthesize import synthesize


def test_settings__differ_between_methods_alone() -> None:
    options = Options(num_gaussians=77)
    settings = {method: options.settings(method, epochs=3, seed=5) for method in METHODS}
    assert len({repr(config) for config in settings.values()}) == len(METHODS)
    assert {(c.fit.num_gaussians, c.fit.epochs, c.seed, c.codec) for c in settings.values()} == {
        (77, 3, 5, settings["default"].codec)
    }


@pytest.mark.slow
def test_main__measures_a_tiny_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field, "METHODS", {name: METHODS[name] for name in ("hicom", "default")})
    clip = tmp_path / "clips" / "random-3"
    synthesize("random", clip, SynthConfig(frames=3, width=64, height=48, spp=1, seed=3))
    work = {
        "num_gaussians": 200,
        "first_frame_steps": 10,
        "epochs": (2,),
        "frames": 3,
    }
    field.main(
        Options(
            json=tmp_path / "out.json",
            plot=tmp_path / "out.png",
            seeds=(3,),
            clips=tmp_path / "clips",
            **work,
        )
    )
    cells = json.loads((tmp_path / "out.json").read_text())["cells"]
    assert list(cells) == ["3/0"]
    assert list(cells["3/0"]) == ["hicom/2", "default/2"]
    for scores in cells["3/0"].values():
        assert scores["num_bytes"] > 0
        assert len(scores["by_frame"]["psnr"]) == 2
        assert "Dynamic 3D Gaussians delta_avg" in scores
    assert field_table(cells).count("\n") == 4
    assert (tmp_path / "out.png").stat().st_size > 1000

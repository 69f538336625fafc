"""`morgs-mi demo`: its options."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from morgs_mi.studio.demo import DemoConfig


def test_demo__passes_its_options_on(tmp_path: Path, run, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[DemoConfig] = []

    def stop(out: Path, config: DemoConfig, progress: object) -> None:
        calls.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr("morgs_mi.studio.demo.run_demo", stop)
    (tmp_path / "a.toml").write_text("seed = 7\n[fit]\nepochs = 2\n")
    assert run("demo", tmp_path)[0] == 130
    options = [
        "--scene",
        "arm",
        "--cameras",
        "4",
        "--frames",
        "5",
        "--width",
        "64",
        "--height",
        "48",
        "--spp",
        "2",
    ]
    assert run("demo", tmp_path, *options, "--config", tmp_path / "a.toml")[0] == 130
    assert run("demo", tmp_path, "--config", tmp_path / "a.toml", "--seed", 1)[0] == 130
    default, small, seeded = calls
    assert default == DemoConfig()
    assert (small.scene, small.stream.seed, small.stream.fit.epochs) == ("arm", 7, 2)
    assert small.clip == replace(default.clip, cameras=4, frames=5, width=64, height=48, spp=2)
    assert small.stream.fit.first_frame_steps == default.stream.fit.first_frame_steps
    assert (seeded.stream.seed, seeded.stream.fit.epochs) == (1, 2)

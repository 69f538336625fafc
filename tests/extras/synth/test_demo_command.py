"""`morgs-mi demo`: its options."""

from dataclasses import replace
from unittest.mock import Mock

from morgs_mi.extras.synth.demo import DemoConfig


def test_demo__passes_its_options_on(tmp_path, run, monkeypatch):
    demo = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("morgs_mi.extras.synth.demo.run_demo", demo)
    (tmp_path / "a.toml").write_text("seed = 7\n[fit]\nepochs = 2\n")
    file = ("--config", tmp_path / "a.toml")
    size = {"cameras": 4, "frames": 5, "width": 64, "height": 48, "spp": 2}
    clip = [text for name, value in size.items() for text in (f"--{name}", value)]
    for options in ((), ("--scene", "arm", *clip, *file), (*file, "--seed", 1)):
        assert run("demo", tmp_path, *options)[0] == 130
    default, small, seeded = (call.args[1] for call in demo.call_args_list)
    assert default == DemoConfig()
    assert (small.scene, small.stream.seed, small.stream.fit.epochs) == ("arm", 7, 2)
    assert small.clip == replace(default.clip, **size)
    assert small.stream.fit.first_frame_steps == default.stream.fit.first_frame_steps
    assert (seeded.stream.seed, seeded.stream.fit.epochs) == (1, 2)

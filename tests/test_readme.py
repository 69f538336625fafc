"""The README stays true: its examples run, its figures are those of the committed result."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from morgs_mi.synth.synthesize import synthesize

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder in which the demo has left its capture, a small one."""
    folder = tmp_path_factory.mktemp("readme")
    synthesize("spheres", folder / "out/demo/capture", num_cameras=3, num_frames=2, width=64, height=48, spp=4)
    return folder


@pytest.mark.parametrize("example", EXAMPLES, ids=["mitsuba", "loop"])
def test_example_runs(example, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    exec(compile(example, "README.md", "exec"), {})


def test_figures_are_those_of_the_committed_demo():
    report = json.loads((ROOT / "benchmarks/results/demo.json").read_text(encoding="utf-8"))
    for name, title in (("full", "ML + MO + MC"), ("plain", "residuals only")):
        row = report["comparison"][name]
        figures = f"{row['psnr']:.2f} dB | {row['motion_error_moving']:.2f} px | {row['motion_error_still']:.2f} px"
        assert f"| {title} | {figures} |" in README
    first, last = (report["full"]["frames"][k]["psnr"] for k in (0, -1))
    assert re.search(rf"goes\s+from {first:.2f} dB\s+to {last:.2f} dB", README)
    arm = json.loads((ROOT / "benchmarks/results/arm.json").read_text(encoding="utf-8"))["frames"]
    assert re.search(rf"from {arm[0]['psnr']:.2f} dB\s+to {arm[-1]['psnr']:.2f} dB over {len(arm)}", README)


def test_what_the_method_is_worth_is_that_of_the_committed_report():
    clips = json.loads((ROOT / "benchmarks/results/method_report.json").read_text(encoding="utf-8"))["clips"]

    def scores(preset: str, name: str) -> list[float]:
        rows = [row for clip in clips for row in clip["rows"] if (row["preset"], row["epochs"]) == (preset, 2)]
        return [row["mean"][name] for row in rows if row["best"]]

    def gains(name: str) -> str:
        added = [ours - theirs for ours, theirs in zip(scores("default", name), scores("baseline", name), strict=True)]
        return f"{min(added):.1f} to {max(added):.1f} dB"

    name = "motion_error_moving"
    shares = [ours / theirs for ours, theirs in zip(scores("default", name), scores("baseline", name), strict=True)]
    said = (
        f"{gains('psnr')} above residuals alone at their best rates ({gains('psnr_moving')} where things move), with "
        f"{min(shares):.1f} to {max(shares):.1f} of their motion error, and PSNR falls by "
        f"{-min(scores('default', 'psnr_slope')):.3f} dB a frame at most"
    )
    assert said in " ".join(README.split())


def test_speed_is_that_of_the_committed_benchmark():
    for workload in ("W1", "W2", "W2b"):
        run = json.loads((ROOT / f"benchmarks/results/render_speed_{workload}.json").read_text(encoding="utf-8"))
        plain = f"{run['plain_step_ms']:.0f} ms" if run.get("plain_step_ms") else "not run"
        assert f"| {run['step_ms']:.0f} ms | {run['ratio_to_yardstick']:.2f} x | {plain} |" in README


def test_seconds_a_frame_are_those_of_the_committed_benchmark():
    found = json.loads((ROOT / "benchmarks/results/frame_speed.json").read_text(encoding="utf-8"))
    big, small = ([found[size]["runs"][f"default, {n} epochs"] for n in (1, 2)] for size in ("n3dv", "small"))
    text = " ".join(README.split())
    assert f"of whose pixels {100 * big[0]['pixels']:.0f} % have to be drawn, one pass over the views" in text
    assert (
        f"takes {big[0]['seconds']:.1f} s a frame, flow and packet included, two passes {big[1]['seconds']:.1f} s"
        in text
    )
    assert f"640x480 {small[0]['seconds']:.1f} s and {small[1]['seconds']:.1f} s" in text


def test_every_command_of_the_readme_exists():
    from morgs_mi.cli import Demo, Eval, Export, Fit, Info, Render, Synth, View

    known = {c.__name__.lower() for c in (Demo, Eval, Export, Fit, Info, Render, Synth, View)}
    named = set(re.findall(r"^ {4}morgs-mi (\w+)", README, re.MULTILINE))
    assert named
    assert named <= known
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^ {4}make (\S+)", README, re.MULTILINE):
        assert f"\n{target}:" in makefile

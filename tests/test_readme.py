"""The README is true: its examples run, its figures agree with the committed result, its commands
exist.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from morgs_mi.cli import COMMANDS
from morgs_mi.studio.synth.synth_config import SynthConfig
from morgs_mi.studio.synth.synthesize import synthesize

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """Return a folder that holds a small capture where the demo writes its own."""
    folder = tmp_path_factory.mktemp("readme")
    synthesize(
        "spheres",
        folder / "out/demo/capture",
        SynthConfig(cameras=3, frames=2, width=64, height=48, spp=4),
    )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=["mitsuba", "loop"])
def test_readme__examples_run(example, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    exec(compile(example, "README.md", "exec"), {})


def test_readme__quotes_the_committed_demo():
    report = json.loads((ROOT / "benchmarks/results/demo.json").read_text(encoding="utf-8"))
    for name, title in (("full", "ML + MO + MC"), ("plain", "residuals only")):
        row = report["comparison"][name]
        figures = (
            f"{row['psnr']:.2f} dB | {row['motion_error_moving']:.2f} px | "
            f"{row['motion_error_still']:.2f} px"
        )
        assert f"| {title} | {figures} |" in README


def test_readme__quotes_the_committed_time_of_an_image():
    rows = json.loads((ROOT / "benchmarks/results/splat_files.json").read_text(encoding="utf-8"))[
        "rows"
    ]
    seconds = {row["gaussians"]: f"{row['image_seconds']:.1f} s" for row in rows}
    sentence = (
        f"takes {seconds[100_000]} with 100,000 Gaussians and {seconds[1_000_000]} with a million, "
        "on two cores"
    )
    assert sentence in " ".join(README.split())


def test_readme__names_commands_that_exist():
    named = set(re.findall(r"^ {4}morgs-mi (\w+)", README, re.MULTILINE))
    assert named
    assert named <= set(COMMANDS)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^ {4}make (\S+)", README, re.MULTILINE):
        assert f"\n{target}:" in makefile


def test_readme__names_the_two_commands_of_a_new_machine_of_which_ci_runs_the_tests():
    commands = "\n    make demo    # [^\n]+\n    make test    # [^\n]+\n"
    assert re.search(commands, README)
    assert "\nmake test\n" in (ROOT / ".ci/run").read_text(encoding="utf-8")


def test_readme__is_short():
    assert len(README.splitlines()) <= 120


def test_readme__cites_the_paper_as_the_other_pages_do():
    (entry,) = re.findall(r"```bibtex\n(.*?)```", README, re.DOTALL)
    page = " ".join((ROOT / "docs/architecture.md").read_text(encoding="utf-8").split())
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    (authors,) = re.findall(r"author += \{(.*)\}", entry)
    names = [
        f"{first_name} {family}"
        for family, first_name in (name.split(", ") for name in authors.split(" and "))
    ]
    cited = zip(
        re.findall(r"family-names: (\w+)", citation),
        re.findall(r"given-names: (\w+)", citation),
        strict=True,
    )
    assert names == [f"{first_name} {family}" for family, first_name in cited]
    assert all(name in text for name in names for text in (page, " ".join(README.split())))

"""The README is true: its examples run, its figures agree with the committed result, its commands
exist.
"""

import re
from pathlib import Path

import pytest

import morgs_mi
from morgs_mi.cli.main import COMMANDS
from morgs_mi.platform.bounded import read_json

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """Return a folder that holds a small capture where the demo writes its own."""
    folder = tmp_path_factory.mktemp("readme")
    morgs_mi.synthesize(
        "spheres",
        folder / "out/demo/capture",
        morgs_mi.SynthConfig(cameras=3, frames=2, width=64, height=48, spp=4),
    )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=["mitsuba", "loop"])
def test_readme__examples_run(example, workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    exec(compile(example, "README.md", "exec"), {})


def result(name):
    return read_json(ROOT / f"benchmarks/results/{name}.json")


def test_readme__quotes_the_committed_demo():
    rows = result("demo")["comparison"]
    for name, title in (("full", "ML + MO + MC"), ("plain", "residuals only")):
        errors = [f"{rows[name][f'motion_error_{part}']:.2f} px" for part in ("moving", "still")]
        assert f"| {title} | {rows[name]['psnr']:.2f} dB | {' | '.join(errors)} |" in README


def test_readme__quotes_the_committed_time_of_an_image():
    rows = result("splat_files")["rows"]
    seconds = {row["gaussians"]: f"{row['image_seconds']:.1f} s" for row in rows}
    sentence = (
        f"takes {seconds[100_000]} with 100,000 Gaussians and {seconds[1_000_000]} with a million, "
        "on two cores"
    )
    assert sentence in " ".join(README.split())


def test_readme__names_commands_that_exist():
    commands = set(re.findall(r"^ {4}morgs-mi (\w+)", README, re.MULTILINE))
    assert commands
    assert commands <= set(COMMANDS)
    # The commands of a new machine, of which CI runs the tests.
    assert re.search("\n    make demo    # [^\n]+\n    make test    # [^\n]+\n", README)
    ci = (ROOT / ".ci/run").read_text(encoding="utf-8")
    assert re.search(r"^make test( |$)", ci, re.MULTILINE)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^ {4}make (\S+)", README, re.MULTILINE):
        assert f"\n{target}:" in makefile

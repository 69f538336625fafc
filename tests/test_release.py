"""The release: versions agree, workflows pin their actions and ask for few permissions."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = {
    path.name: yaml.safe_load(path.read_text(encoding="utf-8"))
    for path in ROOT.glob(".github/**/*.yml")
}
JOBS = [
    (f"{name}: {job}", flow["jobs"][job])
    for name, flow in WORKFLOWS.items()
    for job in flow.get("jobs", {})
]


def check_release(root, tag):
    return subprocess.run(
        [sys.executable, root / "tools/check_release.py", tag], capture_output=True, text=True
    )


@pytest.fixture
def checkout(tmp_path):
    """Copies of the files that name the version."""
    (tmp_path / "tools").mkdir()
    for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md", "tools/check_release.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def test_check_release__compares_the_files_with_the_tag(checkout):
    version = PROJECT["version"]
    if "Source" not in PROJECT["urls"]:
        result = check_release(checkout, f"v{version}")
        assert result.returncode == 1
        assert "expected the addresses Source and Issues" in result.stderr
        pyproject = checkout / "pyproject.toml"
        addresses = '[project.urls]\nSource = "https://a.org"\nIssues = "https://a.org"\n'
        pyproject.write_text(pyproject.read_text().replace("[project.urls]\n", addresses))
    assert check_release(checkout, f"v{version}").returncode == 0
    wrong = check_release(checkout, "v9.9.9")
    assert wrong.returncode == 1
    assert wrong.stderr.count(f"expected version 9.9.9, got {version}") == 3


def test_project__names_its_pythons_and_dependencies_as_the_pages_do():
    pythons = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    promises = (ROOT / "docs/promises.md").read_text(encoding="utf-8")
    assert f"now {pythons[0]} to {pythons[-1]}" in promises
    for flow, job in (("ci.yml", "test"), ("release.yml", "installed")):
        assert WORKFLOWS[flow]["jobs"][job]["strategy"]["matrix"]["python"] == pythons
    for pin in PROJECT["dependencies"]:
        assert f"`{pin}`" in promises or not pin.startswith(("mitsuba", "drjit"))


def test_workflows__pin_their_actions():
    actions = [step["uses"] for _, job in JOBS for step in job["steps"] if "uses" in step]
    assert len(actions) > 8
    assert [use for use in actions if not re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", use)] == []


def test_workflows__read_only_but_for_the_publication():
    flows = [flow for flow in WORKFLOWS.values() if "jobs" in flow]
    assert all(flow["permissions"] == {"contents": "read"} for flow in flows)
    assert {name: job["permissions"] for name, job in JOBS if "permissions" in job} == {
        "release.yml: publish": {"id-token": "write"}
    }
    assert all("timeout-minutes" in job for _, job in JOBS)

"""The worked examples of docs/extending.md run, and those that edit the package do so in the stated
number of files.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import morgs_mi

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
# A directive in a comment, and the code block that follows it.
BLOCK = re.compile(r"<!-- (setup|run|after `[^\n]+` in [^ ]+) -->\n```python\n(.*?)```", re.DOTALL)
SETUP = next(code for directive, code in BLOCK.findall(TEXT) if directive == "setup")
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", TEXT, re.DOTALL | re.MULTILINE))


def edit(package, directive, code):
    """Insert code into a copy of the package after a line, and return the file that changes."""
    anchor, name = re.fullmatch(r"after `(.+)` in (.+)", directive).groups()
    path = package / name
    lines = path.read_text(encoding="utf-8").split("\n")
    assert lines.count(anchor) == 1, f"{name} must have the line {anchor!r} once"
    lines.insert(lines.index(anchor) + 1, code.rstrip("\n"))
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("title", SECTIONS)
def test_extending__example_works_within_its_number_of_files(title, tmp_path):
    section = SECTIONS[title]
    (allowed,) = map(int, re.findall(r"<!-- files: (\d) -->", section))
    package = Path(morgs_mi.__file__).parent
    if allowed:
        package = shutil.copytree(
            package, tmp_path / "morgs_mi", ignore=shutil.ignore_patterns("__pycache__")
        )
    blocks = BLOCK.findall(section)
    touched = {edit(tmp_path, directive, code) for directive, code in blocks if directive != "run"}
    assert len(touched) == allowed
    (example,) = (code for directive, code in blocks if directive == "run")
    script = tmp_path / "example.py"
    script.write_text(
        f"{SETUP}\nassert {str(package)!r} in morgs_mi.__file__\n{example}", encoding="utf-8"
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(package.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
    assert "nan" not in done.stdout

"""The check of assignments and patches, `tools/check_dialect.py`."""

import re
import subprocess
import sys
from pathlib import Path

TOOL = Path(__file__).parents[1] / "tools/check_dialect.py"


def status_and_text(folder, *places):
    """Return the status of the check of some places in a folder, and what it prints."""
    process = subprocess.run(
        [sys.executable, TOOL, *places], cwd=folder, capture_output=True, text=True
    )
    return process.returncode, process.stderr


VIOLATIONS = {
    "a, b = 1, 2": "one value",
    "x[0], x[1] = x[1], x[0]": "one value",
    "self.a, b = 1, c()": "one value",
    "A = B = 1": "one constant",
    'monkeypatch.setattr(module, "_LIMIT", 1)': "a public name",
    'monkeypatch.setattr("package.module._LIMIT", 1)': "a public name",
}


def test_check_dialect__names_violations_by_line(tmp_path):
    (tmp_path / "module.py").write_text("\n".join(VIOLATIONS), encoding="utf-8")
    status, text = status_and_text(tmp_path, ".")
    assert status == 1
    numbers = [int(line.split(":")[1]) for line in text.splitlines()]
    assert sorted(numbers) == [*range(1, len(VIOLATIONS) + 1)]
    for number, part in enumerate(VIOLATIONS.values(), 1):
        assert re.search(rf"^module.py:{number}: .*{part}", text, re.MULTILINE)


def test_check_dialect__accepts_other_code(tmp_path):
    lines = (
        "a, b = b, a",
        "a, b = f()",
        "a, b = (x for x in y)",
        "def f():\n    a = b = 1",
        'monkeypatch.setattr(module, "LIMIT", 1)',
        'monkeypatch.setattr(Value, "__exit__", None)',
    )
    (tmp_path / "module.py").write_text("\n".join(lines), encoding="utf-8")
    assert status_and_text(tmp_path, ".") == (0, "")

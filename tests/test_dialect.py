"""The check of names and assignments, `tools/check_dialect.py`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools/check_dialect.py"


def checked(folder: Path, source: str) -> tuple[int, str]:
    """Return the status of the check of a module, and what it prints."""
    (folder / "module.py").write_text(source, encoding="utf-8")
    return status_and_text(folder, ".")


def status_and_text(folder: Path, *places: str) -> tuple[int, str]:
    """Return the status of the check of some places in a folder, and what it prints."""
    process = subprocess.run(
        [sys.executable, TOOL, *places], cwd=folder, capture_output=True, text=True
    )
    return process.returncode, process.stderr


@pytest.mark.parametrize(
    ("source", "line", "part"),
    [
        ("a, b = 1, 2\n", 1, "one value"),
        ("\nx[0], x[1] = y, z\n", 2, "one value"),
        ("x[0], x[1] = x[1], x[0]\n", 1, "one value"),
        ("def f():\n    self.a, b = 1, c()\n", 2, "one value"),
        ("A = B = 1\n", 1, "one constant"),
        ("found = 1\n", 1, "`found`"),
        ("for known in x: pass\n", 1, "`known`"),
        ("with x as own: pass\n", 1, "`own`"),
        ("y = [seen for seen in x]\n", 1, "`seen`"),
        ("if (before := x): pass\n", 1, "`before`"),
        ("def f(*, given): pass\n", 1, "`given`"),
        ("f = lambda after: 1\n", 1, "`after`"),
        ("self._kept = 1\n", 1, "`kept`"),
        ('monkeypatch.setattr(module, "_LIMIT", 1)\n', 1, "a public name"),
        ('monkeypatch.setattr("package.module._LIMIT", 1)\n', 1, "a public name"),
    ],
)
def test_check_dialect__names_a_violation(
    tmp_path: Path, source: str, line: int, part: str
) -> None:
    status, text = checked(tmp_path, source)
    assert status == 1
    assert text.startswith(f"module.py:{line}: ")
    assert part in text
    assert text.count("\n") == 1


@pytest.mark.parametrize(
    "source",
    [
        "a, b = b, a\n",
        "a, b = f()\n",
        "a, b = (x for x in y)\n",
        "def f():\n    a = b = 1\n",
        "x = y.found\n",
        "f(found=1)\n",
        "def found(): pass\n",
        'monkeypatch.setattr(module, "LIMIT", 1)\n',
        'monkeypatch.setattr(Value, "__exit__", None)\n',
    ],
)
def test_check_dialect__accepts_other_code(tmp_path: Path, source: str) -> None:
    assert checked(tmp_path, source) == (0, "")


def test_check_dialect__takes_modules_and_refuses_to_check_none(tmp_path: Path) -> None:
    checked(tmp_path, "A = B = 1\n")
    assert "one constant" in status_and_text(tmp_path, "module.py")[1]
    for places in ((), ("nowhere",)):
        status, text = status_and_text(tmp_path, *places)
        assert status == 1
        assert "found none" in text

"""Commands of the pages of experiments: every option exists."""

from __future__ import annotations

import re
import shlex
from importlib import import_module

import tyro

from benchmarks.pages.__main__ import PAGES
from benchmarks.reports import __main__ as reports

TEXT = "\n".join(path.read_text(encoding="utf-8") for path in sorted(PAGES.glob("*.md"))).replace(
    "\\\n", " "
)
COMMANDS = re.findall(r"^ {4}.*python -m (benchmarks\.(?:reports|speed)\S*.*)$", TEXT, re.MULTILINE)


def test_commands__have_options_that_exist():
    assert len(COMMANDS) > 12
    for command in COMMANDS:
        name, *args = shlex.split(command)
        assert tyro.cli(
            reports.Options if name == "benchmarks.reports" else import_module(name).Options,
            args=args,
        )
